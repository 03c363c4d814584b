"""The report of a campaign: share of success, sensitivity, the worst runs, as one page."""
