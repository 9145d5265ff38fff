"""The geometric map from laser scans and odometry alone, with loop closure. Sect. 2.1."""
