"""Where every frame of the robot is: a tree of fixed transforms, looked up in any direction."""

from __future__ import annotations

import difflib
from collections import deque
from collections.abc import Iterable, Mapping

import numpy as np

from soundmap.config import PlanarMount
from soundmap.errors import ConfigError
from soundmap.geometry import Mount

MAX_MOUNT_M = 100.0
"""No sensor is farther than this from the base of its robot."""

SAME_M = 0.005
"""Two accounts of where a frame is agree if they differ by no more, also 1 m from it."""


class FrameTree:
    """Fixed transforms between frames.

    Parameters
    ----------
    edges : mapping
        (parent, child) to the mount of the child in the parent's frame.
    """

    def __init__(self, edges: Mapping[tuple[str, str], Mount]) -> None:
        self._edges = dict(edges)
        self._neighbours: dict[str, dict[str, Mount]] = {}
        self._parents: dict[str, str] = {}
        for (parent, child), mount in edges.items():
            self._neighbours.setdefault(parent, {})[child] = mount
            self._neighbours.setdefault(child, {})[parent] = mount.inverse()
            self._parents[child] = parent

    @property
    def frames(self) -> tuple[str, ...]:
        """All frames, in alphabetical order."""
        return tuple(sorted(self._neighbours))

    def __contains__(self, frame: str) -> bool:
        return frame in self._neighbours

    def root(self, frame: str) -> str:
        """The frame at the top of the one given; itself if it has no parent."""
        seen = {frame}
        while frame in self._parents and self._parents[frame] not in seen:
            frame = self._parents[frame]
            seen.add(frame)
        return frame

    @property
    def roots(self) -> tuple[str, ...]:
        """The frames without a parent, in alphabetical order."""
        return tuple(sorted({self.root(frame) for frame in self._neighbours}))

    @property
    def contradictions(self) -> tuple[tuple[str, str], ...]:
        """Transforms, parent and child, that do not fit what the others say."""
        found = []
        for (parent, child), told in self._edges.items():
            used = self.mount(parent, child)
            if used is None:
                continue
            off_m = np.linalg.norm(used.translation_m - told.translation_m)
            if max(off_m, np.abs(used.rotation - told.rotation).max()) > SAME_M:
                found.append((parent, child))
        return tuple(found)

    def mount(self, base: str, frame: str) -> Mount | None:
        """Where ``frame`` is in the frame ``base``; None if no chain leads there."""
        identity = Mount.planar(0.0, 0.0, 0.0, 0.0)
        found = {base: identity}
        queue = deque([base])
        while queue:
            here = queue.popleft()
            if here == frame:
                return found[here]
            for there, step in self._neighbours.get(here, {}).items():
                if there not in found:
                    found[there] = found[here] @ step
                    queue.append(there)
        return None


class Mounts:
    """Mounts in the base frame: from the configuration, else from the log.

    Parameters
    ----------
    tree : FrameTree
        What the log says.
    base : str
        The base frame of the robot.
    configured : mapping
        x, y, z [m] and yaw [rad] by frame; wins over the log.
    log_name : str
        For messages.
    """

    def __init__(
        self, tree: FrameTree, base: str, configured: Mapping[str, PlanarMount], log_name: str
    ) -> None:
        self.tree, self.base, self._log_name = tree, base, log_name
        self.configured = {
            name.removeprefix("/"): Mount.planar(*values) for name, values in configured.items()
        }

    def get(self, frame: str) -> Mount | None:
        """Where a frame is in the base frame, None if nothing says so."""
        if frame in self.configured:
            return self.configured[frame]
        return self.tree.mount(self.base, frame)

    def mount(self, frame: str, user: str) -> Mount:
        """Where a frame is in the base frame.

        Raises
        ------
        ConfigError
            Neither the log nor the configuration says; ``user`` tells whose frame it is.
        """
        found = self.get(frame)
        if found is None:
            raise ConfigError(self.missing(frame, user))
        return self.credible(found, frame)

    def credible(self, mount: Mount, frame: str) -> Mount:
        """The mount of a frame, if it can be one.

        Raises
        ------
        ConfigError
            It is not on the robot.
        """
        away_m = float(np.linalg.norm(mount.translation_m))
        if away_m > MAX_MOUNT_M:
            raise ConfigError(
                f"{self._log_name}: frame {frame!r} is {away_m:.3g} m away from the base frame "
                f"{self.base!r}, expected at most {MAX_MOUNT_M:.0f} m. Give its mount in the "
                f'configuration: [mounts] "{frame}" = [x, y, z, yaw_rad].'
            )
        return mount

    def missing(self, frame: str, user: str) -> str:
        """What to tell about a frame whose mount is unknown."""
        known = sorted({self.base, *self.configured, *self.tree.frames} - {""})
        near = nearest_names(frame, known)
        hint = f" Did you mean {near}?" if near else ""
        return (
            f"{self._log_name}: the mount of frame {frame!r} ({user}) in the base frame "
            f"{self.base!r} is unknown. Frames known: {', '.join(known) or 'none'}.{hint} Give it "
            f'in the configuration: [mounts] "{frame}" = [x, y, z, yaw_rad].'
        )


def nearest_names(name: str, known: Iterable[str]) -> str:
    """The known names that look like the one given, for a message; empty if none does."""
    return ", ".join(difflib.get_close_matches(name, list(known), n=3, cutoff=0.6))
