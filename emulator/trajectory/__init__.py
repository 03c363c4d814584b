"""Where things are and how they are turned, at any instant."""
