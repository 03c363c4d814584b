"""Drawing with OpenGL: the context, the render targets and the read-back."""
