"""GigE Vision as bytes: control (GVCP), stream (GVSP), registers, and a model of the Triton2 EVS built on them."""
