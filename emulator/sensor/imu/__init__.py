"""The inertial measurement unit beside the sensor: the motion of its elements, with their errors."""
