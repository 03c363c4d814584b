"""The verbs below `evstim listen`, one for each kind of link."""
