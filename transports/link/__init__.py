"""Links: an event device, its endpoint, and their process."""
