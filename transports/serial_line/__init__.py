"""Event telemetry on serial lines: ports that never wait, the baud rate kept by ourselves, and a reader."""
