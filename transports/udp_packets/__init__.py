"""The instrument's packets in UDP datagrams, for ground systems and flight software that take them so."""
