"""Messages between Basilisk and its visualiser Vizard: requests and replies, and the state of a simulation."""
