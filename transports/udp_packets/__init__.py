"""Packets of the instrument in UDP datagrams, for ground systems and flight software that receive them in this form."""
