"""The DAVIS346 as its host sees it on USB."""
