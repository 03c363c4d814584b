"""From a scene to events, and the run that ties it together."""
