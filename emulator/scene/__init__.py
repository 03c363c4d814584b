"""What the camera looks at."""
