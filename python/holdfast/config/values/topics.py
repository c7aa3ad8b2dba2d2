"""MQTT topics: filters, names and templates, and whether each is valid."""

from __future__ import annotations

import re

from holdfast.config.text.messages import show
from holdfast.net.mqtt import MAX_TEXT

DEVICE, TAG = "{device}", "{tag}"


def parse_topic_filter(text: object) -> str:
    """Checks a topic filter. Raises `ValueError` if MQTT 5, section 4.7, does not allow it."""
    allowed = f"allowed: a topic filter of 1 to {MAX_TEXT} bytes"
    if not isinstance(text, str):
        raise ValueError(f"found {show(text)}, {allowed}")
    size = len(text.encode(errors="surrogatepass"))
    if not 1 <= size <= MAX_TEXT:
        raise ValueError(f"found text of {size} bytes, {allowed}")
    if re.search("[\0\ud800-\udfff]", text):
        raise ValueError(f"found {show(text)}, allowed: a topic filter without NUL or surrogates")
    *inner, last = text.split("/")
    if "#" in "".join(inner) or ("#" in last and last != "#"):
        raise ValueError(f"found {show(text)}, allowed: '#' only alone in the last level")
    if any("+" in level and level != "+" for level in (*inner, last)):
        raise ValueError(f"found {show(text)}, allowed: '+' only alone in its level")
    return text


def parse_topic_name(text: object) -> str:
    """Checks the name of a topic to publish to. Raises `ValueError`."""
    name = parse_topic_filter(text)
    if "+" in name or "#" in name or name.startswith("$"):
        raise ValueError(f"found {show(name)}, allowed: a topic without +, # and $ at its begin")
    return name


def parse_topic_template(text: object) -> str:
    """Checks a topic with placeholders. Raises `ValueError`.

    A placeholder is a whole level, so that no two tags share a topic.
    """
    template = parse_topic_name(text)
    levels = template.split("/")
    for level in levels:
        if level not in (DEVICE, TAG) and ("{" in level or "}" in level):
            known = re.fullmatch(r"\{[^{}]*\}", level) is None and (DEVICE in level or TAG in level)
            words = "each alone in its level" if known else f"only {DEVICE} and {TAG}"
            raise ValueError(f"found {show(template)}, allowed as placeholders: {words}")
    if levels.count(DEVICE) != 1 or levels.count(TAG) > 1:
        raise ValueError(f"found {show(template)}, allowed: {DEVICE} once, {TAG} at most once")
    return template


def without_share(topic: str) -> str:
    """Returns the filter of a shared subscription, `$share/group/filter`; other filters as is."""
    share, _, rest = topic.partition("/")
    group, _, shared = rest.partition("/")
    return shared if share == "$share" and group and shared else topic


def overlap(one: str, other: str) -> bool:
    """Whether a topic can match both filters."""
    first, second = (without_share(each).split("/") for each in (one, other))
    for level, against in zip(first, second, strict=False):
        if "#" in (level, against):
            return True
        if level != against and "+" not in (level, against):
            return False
    # `a/#` matches `a` too.
    return (first[len(second) :] or second[len(first) :]) in ([], ["#"])
