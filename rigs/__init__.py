"""The rigs that ship with evstim, one TOML file each."""
