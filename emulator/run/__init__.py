"""A run of a rig: assembly, session, pacing, ledger, triggers and control."""
