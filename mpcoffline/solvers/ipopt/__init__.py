"""IPOPT through CasADi: slow, and takes any smooth problem."""
