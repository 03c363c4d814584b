"""What Basilisk says to its visualiser Vizard: requests and replies, and the message of a simulation's state."""
