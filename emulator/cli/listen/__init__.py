"""Commands below `evstim listen`, one for each kind of link."""
