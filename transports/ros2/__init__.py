"""Topics of ROS 2 without ROS: DDS by CycloneDDS, on the loopback interface unless a rig selects others."""
