"""Event telemetry for small computers: self-contained blocks of events or edges, described in docs/packets.md."""
