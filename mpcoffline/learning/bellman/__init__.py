"""The Bellman equation as regressions for theta: (FIT), and the convex fit of the cost."""
