"""Common parts of cameras with sensors of Prophesee's: stream, fates, biases, the Treuzell protocol, the USB side."""
