"""The report of a run: its observation, its numbers, and the page, the JSON and the JUnit file made of them."""
