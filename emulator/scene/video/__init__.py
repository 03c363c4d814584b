"""A video or a sequence of images as a scene."""
