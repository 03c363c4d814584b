"""Reports for people: HTML pages, charts and preview pictures."""
