"""Which topics to use: those the configuration names, else the only ones of their kind."""

from __future__ import annotations

from soundmap.config import Config
from soundmap.errors import ConfigError, NothingUsableError
from soundmap.logs.messages import Form, Kind
from soundmap.logs.mounts import nearest_names
from soundmap.logs.survey import Survey, Topic

_KEYS = {Kind.AUDIO: "audio", Kind.LASER: "lasers", Kind.ODOMETRY: "odometry"}


def audio_topic(survey: Survey, config: Config, log_name: str) -> Topic:
    """The topic with the microphones' samples.

    Raises
    ------
    ConfigError
        Several could be meant, or the configured one is missing or of another kind.
    NothingUsableError
        There is none.
    """
    if config.topics.audio is not None:
        return _configured(survey, config.topics.audio, Kind.AUDIO, log_name)
    found = [t for t in survey.of_kind(Kind.AUDIO) if t.messages]
    # Bytes called data may be anything; they count only where nothing better is.
    found = [t for t in found if t.form is not Form.AUDIO_DATA] or found
    if found and found[0].form is Form.AUDIO_DATA and not survey.of_kind(Kind.AUDIO_INFO):
        found = []
    return _only(survey, found, Kind.AUDIO, log_name)


def odometry_topic(survey: Survey, config: Config, log_name: str) -> Topic | None:
    """The topic with odometry messages; None if only transforms can tell.

    Raises
    ------
    ConfigError
        Several could be meant, or the configured one is missing or of another kind.
    """
    if config.topics.odometry is not None:
        name = config.topics.odometry
        topic = survey.topics.get(name)
        if topic is not None and topic.kind is Kind.TRANSFORMS:
            return None
        return _configured(survey, name, Kind.ODOMETRY, log_name)
    found = [t for t in survey.of_kind(Kind.ODOMETRY) if t.messages]
    return _only(survey, found, Kind.ODOMETRY, log_name) if found else None


def laser_topics(survey: Survey, config: Config, log_name: str) -> tuple[Topic, ...]:
    """The topics with laser scans.

    Raises
    ------
    ConfigError
        A configured one is missing or of another kind.
    NothingUsableError
        There is none.
    """
    if config.topics.lasers is not None:
        return tuple(
            _configured(survey, name, Kind.LASER, log_name) for name in config.topics.lasers
        )
    found = tuple(t for t in survey.of_kind(Kind.LASER) if t.messages)
    if not found:
        raise NothingUsableError(nothing_of(survey, Kind.LASER, log_name))
    return found


def nothing_of(survey: Survey, kind: Kind, log_name: str) -> str:
    """What to say when a kind of topic is missing: what is there instead, what is unreadable."""
    shown = [f"{t.name} ({t.schema or t.encoding or 'no type'})" for t in survey.topics.values()]
    there = ", ".join(shown[:12]) + (f" and {len(shown) - 12} more" if len(shown) > 12 else "")
    problems = [f"{t.name}: {t.problem}" for t in survey.topics.values() if t.problem]
    unreadable = f" Not readable: {'; '.join(problems[:4])}." if problems else ""
    return (
        f"{log_name}: no {kind} topic. The log holds {there or 'no messages at all'}.{unreadable} "
        f"Record a topic with {kind} as well."
    )


def _only(survey: Survey, found: list[Topic], kind: Kind, log_name: str) -> Topic:
    if not found:
        raise NothingUsableError(nothing_of(survey, kind, log_name))
    if len(found) > 1:
        names = ", ".join(t.name for t in found)
        raise ConfigError(
            f"{log_name}: {len(found)} {kind} topics: {names}. Choose one in the configuration: "
            f'[topics] {_KEYS[kind]} = "{found[0].name}".'
        )
    return found[0]


def _configured(survey: Survey, name: str, kind: Kind, log_name: str) -> Topic:
    topic = survey.topics.get(name)
    of_kind = [t.name for t in survey.of_kind(kind)]
    choices = f"{kind} topics in the log: {', '.join(of_kind) or 'none'}."
    if topic is None or not topic.messages:
        near = nearest_names(name, survey.topics)
        hint = f" Did you mean {near}?" if near else ""
        raise ConfigError(
            f"{log_name}: no messages on {name}, which [topics] {_KEYS[kind]} names.{hint} "
            f"{choices}"
        )
    if topic.kind is not kind:
        why = f" ({topic.problem})" if topic.problem else ""
        raise ConfigError(
            f"{log_name}: topic {name} holds {topic.schema or topic.encoding}{why}, not {kind} as "
            f"[topics] {_KEYS[kind]} says. {choices}"
        )
    return topic
