"""The report of a run: what was observed while it went on, and the page, JSON and JUnit made of it."""
