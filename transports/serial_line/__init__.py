"""Event telemetry on serial lines: non-blocking ports, pacing at the baud rate, and a reader."""
