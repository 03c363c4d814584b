"""Messages of ROS 2 as bytes: packets of events, and images."""
