"""GigE Vision over UDP: the camera's side, and a receiver."""
