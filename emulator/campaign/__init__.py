"""Campaigns: many runs of a rig over sampled parameters, their table and their report."""
