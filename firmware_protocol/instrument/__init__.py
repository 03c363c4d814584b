"""An event camera without USB: what it is told, what it says, and how it keeps to a narrow line."""
