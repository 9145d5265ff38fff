"""Where the robot was: particle filter in the geometric map (Sect. 2.2)."""
