"""From light to events: pixels and read-out."""
