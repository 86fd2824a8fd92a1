"""Rays: intersectors, and what they meet."""
