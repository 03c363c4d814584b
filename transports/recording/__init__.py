"""Recordings of events in the formats of other programs: contents, readers, and our own writer and reader of each."""
