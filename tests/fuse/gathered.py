from soundmap.fuse.surroundings import SurroundingsGatherer


def gathered_surroundings(lasers, odometry):
    """The surroundings of a whole run."""
    gatherer = SurroundingsGatherer(odometry)
    for scan in lasers:
        gatherer.see(scan)
    return gatherer.gathered()
