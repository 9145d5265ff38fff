"""From bearings and ranges to emitted power on the map (Sect. 2.4, Eqs. 3-5)."""
