"""The tables of a scene file: a room, what sounds in it, and the robot that drives through it.

Lengths are metres, times seconds, levels dB(A); angles are degrees, as people write scenes, and
become radians where they are used. Positions are in the map frame, mounts in the robot's.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from soundmap.geometry import FloatArray

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Point = tuple[float, float]
Point3 = tuple[float, float, float]
PlanarMount = tuple[float, float, float, float]
Sound = Literal[
    "air_conditioner", "fan", "server_rack", "pump", "leak", "transformer", "speech_like", "white"
]


AudioSchema = Literal[
    "audio_utils_msgs/msg/AudioFrame",
    "foxglove.RawAudio",
    "foxglove_msgs/msg/RawAudio",
    "audio_common_msgs/msg/AudioDataStamped",
    "audio_msgs/msg/Audio",
]


class Table(BaseModel):
    """One table of a scene: nothing unknown in it, nothing changed once read."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Room(Table):
    """What is the same everywhere in the room."""

    height_m: Positive = 2.6
    floor_reflection: Share = 0.8
    """Sound pressure reflection coefficient [-]."""
    ceiling_reflection: Share = 0.7
    image_order: Annotated[int, Field(ge=0, le=4)] = 2
    """Reflections followed one by one; later ones make up the diffuse tail."""
    reverberation_s: NotNegative | None = None
    """Reverberation time; left out: Eyring's, from the coefficients. 0: no tail."""
    speed_of_sound_m_s: Positive = 343.0
    map_cell_m: Positive = 0.05


class Wall(Table):
    """A closed outline of walls. The first bounds the room; those inside it are pillars."""

    name: str
    corners_m: Annotated[tuple[Point, ...], Field(min_length=3)]
    reflection: Share | tuple[Share, ...] = 0.9
    """Sound pressure reflection coefficient, one for all walls or one for each."""

    @model_validator(mode="after")
    def _one_coefficient_a_wall(self) -> Wall:
        if isinstance(self.reflection, tuple) and len(self.reflection) != len(self.corners_m):
            raise ValueError(
                f"reflection has {len(self.reflection)} values, the outline {len(self.corners_m)} "
                "walls; give one number or one a wall"
            )
        return self


class Furniture(Table):
    """A thing that lasers see. Sound passes it; it is on the geometric map only if asked."""

    name: str
    corners_m: Annotated[tuple[Point, ...], Field(min_length=3)] | None = None
    centre_m: Point | None = None
    size_m: tuple[Positive, Positive] | None = None
    yaw_deg: float = 0.0
    bottom_m: NotNegative = 0.0
    top_m: Positive = 2.0
    on_map: bool = False

    @model_validator(mode="after")
    def _one_shape(self) -> Furniture:
        box = self.centre_m is not None and self.size_m is not None
        if box == (self.corners_m is not None):
            raise ValueError("give either corners_m, or centre_m and size_m")
        return self

    def outline(self) -> FloatArray:
        """Corners, shape (K, 2) [m]."""
        if self.corners_m is not None:
            return np.array(self.corners_m, dtype=np.float64)
        if self.centre_m is None or self.size_m is None:
            raise ValueError("a box needs centre_m and size_m")
        return box_outline(self.centre_m, self.size_m, math.radians(self.yaw_deg))


class Person(Table):
    """Someone walking to and fro along way points; lasers see two legs."""

    name: str
    way_points_m: Annotated[tuple[Point, ...], Field(min_length=1)]
    speed_m_s: Positive = 1.0
    leg_radius_m: Positive = 0.06


class Source(Table):
    """Something that sounds."""

    id: str
    position_m: Point3
    facing_deg: float = 0.0
    """Direction of the axis, counter-clockwise from the map's x axis."""
    front_to_back_db: NotNegative = 0.0
    """Directivity: how much less sounds to the back than on the axis; 0 is omnidirectional."""
    level_dba_5cm: float
    """A-weighted sound pressure level measured on the axis at 5 cm (Sect. 3)."""
    sound: Sound = "white"
    wav: str | None = None
    """A PCM wav file beside the scene file, repeated as needed, instead of a built-in sound."""
    box_m: tuple[Positive, Positive, Positive] | None = None
    """Width, depth, height of a cabinet behind the source, as the lasers see it."""
    on_s: Positive | None = None
    """An intermittent source sounds this long ..."""
    off_s: Positive | None = None
    """... and then is silent this long, over and over."""
    way_points_m: tuple[Point, ...] = ()
    """A moving source goes to and fro between `position_m` and these points."""
    speed_m_s: Positive = 0.8

    @model_validator(mode="after")
    def _complete(self) -> Source:
        if (self.on_s is None) != (self.off_s is None):
            raise ValueError("an intermittent source needs both on_s and off_s")
        return self

    def box_outline(self) -> FloatArray | None:
        """Cabinet seen from above, its front at the source, shape (4, 2) [m]."""
        if self.box_m is None:
            return None
        width, depth, _ = self.box_m
        yaw = math.radians(self.facing_deg)
        behind = np.array([math.cos(yaw), math.sin(yaw)]) * -0.5 * depth
        x, y = np.array(self.position_m[:2]) + behind
        return box_outline((x, y), (depth, width), yaw)


class Run(Table):
    """One drive: which sources sound and who walks about."""

    name: str
    sources: tuple[str, ...]
    people: tuple[str, ...] | None = None
    """Left out: everyone."""


class Robot(Table):
    """How the robot drives. It rests at the start and at the end."""

    way_points_m: Annotated[tuple[Point, ...], Field(min_length=1)]
    speed_m_s: Positive = 0.5
    acceleration_m_s2: Positive = 0.5
    turn_radius_m: Positive = 0.5
    turn_rate_rad_s: Positive = 0.8
    rest_s: NotNegative = 1.5
    heading_deg: float | None = None
    """At the start; left out: toward the second way point."""
    radius_m: Positive = 0.25
    """No way point and no leg of the route may come nearer to a wall."""
    base_frame: str = "base_link"


class Array(Table):
    """The microphone array as it truly is; `robot.toml` gets the nominal one."""

    frame: str = "mic_array"
    mount: PlanarMount = (0.0, 0.0, 0.35, 0.0)
    """x, y, z [m] and yaw [rad] in the base frame, which is on the floor."""
    microphones: Annotated[int, Field(ge=1)] = 16
    radius_m: Positive = 0.155
    first_angle_rad: float = 0.0
    positions_m: tuple[Point3, ...] | None = None
    """In channel order, instead of a circle."""
    position_error_m: NotNegative = 0.0
    """Standard deviation of each coordinate of each microphone."""
    gain_error_db: NotNegative = 0.0
    """Standard deviation of each microphone's gain."""
    self_noise_dba: float = 28.0
    pascal_per_count: Positive = 8.61e-4
    """Sound pressure of one step of the analogue-to-digital converter [Pa]. The default is that
    of a 16 bit digital microphone of -26 dB full scale at 94 dB."""

    def nominal_positions(self) -> FloatArray:
        """Positions in the array's frame, shape (Q, 3) [m]."""
        if self.positions_m is not None:
            return np.array(self.positions_m, dtype=np.float64)
        turn = np.arange(self.microphones) / self.microphones
        angle = self.first_angle_rad + 2.0 * np.pi * turn
        circle = [self.radius_m * np.cos(angle), self.radius_m * np.sin(angle), 0.0 * angle]
        return np.stack(circle, axis=-1)


class Gap(Table):
    """Messages that never reached the log."""

    start_s: NotNegative
    duration_s: Positive


class Clock(Table):
    """How a sensor's stamps and their arrival differ from true time."""

    offset_s: float = 0.0
    """Added to every stamp."""
    drift_ppm: float = 0.0
    """How much faster than nominal the sensor's own clock runs."""
    jitter_s: NotNegative = 0.0
    """Standard deviation of a stamp."""
    latency_s: NotNegative = 0.002
    """From the measurement's end to the log, at least ..."""
    latency_jitter_s: NotNegative = 0.0005
    """... and the mean of what comes on top."""
    gaps: tuple[Gap, ...] = ()


class Laser(Table):
    """A laser scanner; the defaults are those of a Hokuyo UTM-30LX."""

    topic: str
    frame: str
    mount: PlanarMount
    field_deg: Annotated[float, Field(gt=0, le=360)] = 270.0
    step_deg: Positive = 0.25
    rate_hz: Positive = 40.0
    range_min_m: NotNegative = 0.1
    range_max_m: Positive = 30.0
    noise_m: NotNegative = 0.01
    """Standard deviation of a range at distance 0 ..."""
    noise_per_m: NotNegative = 0.001
    """... and its growth with the distance."""
    dropout_share: Share = 0.003
    """Rays that do not come back."""
    phase_s: NotNegative = 0.01
    """When the first sweep begins; the odometry begins at 0."""
    clock: Clock = Clock()


class Odometry(Table):
    """Wheel odometry of a differential drive."""

    topic: str = "/odom"
    frame: str = "odom"
    rate_hz: Positive = 50.0
    wheelbase_m: Positive = 0.33
    left_scale: Positive = 1.0
    """Measured over true way of the left wheel: the systematic error."""
    right_scale: Positive = 1.0
    wheelbase_scale: Positive = 1.0
    """Assumed over true distance of the wheels."""
    noise_m_per_sqrt_m: NotNegative = 0.002
    """Random error of each wheel's way [m] after 1 m; it grows with the way's square root."""
    publish_tf: bool = True
    clock: Clock = Clock()


class Audio(Table):
    """How the recorder writes sound."""

    topic: str = "/audio"
    schema_name: AudioSchema = "audio_utils_msgs/msg/AudioFrame"
    """AudioFrame is stamped at the end of its block, all others at the start. foxglove.RawAudio
    is protobuf; AudioDataStamped has its AudioInfo, sent once, on ``<topic>_info``."""
    rate_hz: Positive = 48000.0
    block_frames: Annotated[int, Field(ge=16)] = 480
    clock: Clock = Clock()


class Noise(Table):
    """Sound that comes from no source."""

    ambient_dba: float = 42.0
    """Spatially diffuse noise; a level below -100 is silence."""
    drive_dba: float = 40.0
    """The robot's own motors at the array, at full speed; below -100 they are silent."""


class Scene(Table):
    """Everything that a simulated log depends on."""

    name: str
    seed: Annotated[int, Field(ge=0)] = 1
    start_time_s: NotNegative = 1_700_000_000.0
    """Of the log, since 1970."""
    room: Room = Room()
    walls: Annotated[tuple[Wall, ...], Field(min_length=1)]
    furniture: tuple[Furniture, ...] = ()
    people: tuple[Person, ...] = ()
    sources: tuple[Source, ...] = ()
    runs: tuple[Run, ...] = ()
    robot: Robot
    array: Array = Array()
    lasers: tuple[Laser, ...] = (
        Laser(topic="/scan_front", frame="laser_front", mount=(0.18, 0.0, 0.3, 0.0)),
        Laser(
            topic="/scan_back",
            frame="laser_back",
            mount=(-0.22, 0.0, 0.3, math.pi),
            phase_s=0.017,
        ),
    )
    odometry: Odometry = Odometry()
    audio: Audio = Audio()
    noise: Noise = Noise()


def box_outline(centre_m: Point, size_m: Point, yaw_rad: float) -> FloatArray:
    """Corners of a turned rectangle, counter-clockwise, shape (4, 2) [m]."""
    corners = 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.asarray(size_m)
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    turned = corners @ np.array([[cos, sin], [-sin, cos]])
    return np.asarray(turned + np.asarray(centre_m))
