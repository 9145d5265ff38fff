"""How loud each bearing is where the robot stands (Sect. 2.3, Eqs. 1-2)."""
