"""The inertial measurement unit beside the sensor: what its elements feel, with their errors."""
