"""Path of the aircraft, pointing of its gimbal, and the true pose at any time."""

from glintrack.flight.design import FlightDesign
from glintrack.flight.paths import Flight, build_flight, check_recorded, check_waypoints

__all__ = ["Flight", "FlightDesign", "build_flight", "check_recorded", "check_waypoints"]
