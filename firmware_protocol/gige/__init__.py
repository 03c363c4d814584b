"""GigE Vision as bytes: control (GVCP), stream (GVSP), registers, and the Triton2 EVS that is made of them."""
