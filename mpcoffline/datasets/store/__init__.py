"""The Minari store on this machine: what is in it, checked before it is read, written whole or not at all."""
