"""Dynamics from outside: a Functional Mock-up Unit flies, and its poses go to the live path of a rig."""
