"""Events of a real camera, or of an earlier run, in place of a simulated sensor."""
