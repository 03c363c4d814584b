"""Dynamics from outside: a Functional Mock-up Unit is simulated, and its poses go to the live path of a rig."""
