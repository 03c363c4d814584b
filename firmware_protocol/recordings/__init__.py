"""File formats of event recordings, as bytes: AEDAT 2.0, AEDAT 3.1, and the frame of AEDAT 4.0 files."""
