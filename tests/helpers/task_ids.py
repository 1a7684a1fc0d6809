"""The tasks of the paper, by name: the list of all may grow."""

LINEAR = "mpcoffline/LinearTracking-v0"
PENDULUM = "mpcoffline/PendulumSwingUp-v0"
CARTPOLE = "mpcoffline/CartPoleSwingUp-v0"
