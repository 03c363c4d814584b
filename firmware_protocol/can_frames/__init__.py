"""CAN without a bus: frames, what is in them, how long they take, and who may send next."""
