"""Recordings of events in the formats of others: what each holds, who reads it, its writer and its reader."""
