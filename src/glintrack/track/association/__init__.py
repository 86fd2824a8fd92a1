"""Association of detections with tracks."""
