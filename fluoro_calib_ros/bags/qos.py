# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""QoS profiles as bags contain them: YAML in a channel's metadata and in metadata.yaml."""

from __future__ import annotations

from typing import Any

import yaml

from ..files.yaml_text import parse_yaml

_INFINITE = {'sec': 9223372036, 'nsec': 854775807}  # RMW_DURATION_INFINITE
# Bags from before Jazzy number the policies (rmw/types.h).
_POLICY_NAMES = {
    'history': ('system_default', 'keep_last', 'keep_all', 'unknown'),
    'reliability': ('system_default', 'reliable', 'best_effort', 'unknown', 'best_available'),
    'durability': ('system_default', 'transient_local', 'volatile', 'unknown', 'best_available'),
    'liveliness': (
        'system_default',
        'automatic',
        'manual_by_node',
        'manual_by_topic',
        'unknown',
        'best_available',
    ),
}


def profile(
    reliability: str = 'reliable', durability: str = 'volatile', depth: int = 10
) -> dict[str, Any]:
    """Return a QoS profile {policy: value} as rosbag2 writes it.

    Keep last, without deadline and lifespan.
    """
    return {
        'history': 'keep_last',
        'depth': depth,
        'reliability': reliability,
        'durability': durability,
        'deadline': dict(_INFINITE),
        'lifespan': dict(_INFINITE),
        'liveliness': 'automatic',
        'liveliness_lease_duration': dict(_INFINITE),
        'avoid_ros_namespace_conventions': False,
    }


PROFILES = {'observations': profile(), 'latched': profile(durability='transient_local', depth=1)}


def to_yaml(value: Any) -> str:
    """Return a value as YAML as rosbag2 does: block style, keys in order, no final newline."""
    return yaml.dump(
        value, Dumper=_Dumper, sort_keys=False, default_flow_style=False, width=10**6
    ).rstrip('\n')


def parse_profiles(value: Any) -> list[dict[str, Any]]:
    """Return QoS profiles from the YAML text, or the list, in a bag; policies by name.

    A text that cannot be parsed gives no profiles: a bag can be read without them.
    """
    try:
        items = parse_yaml(value) if isinstance(value, str) else value
    except yaml.YAMLError:
        return []
    if not isinstance(items, list):
        return []
    return [_with_policy_names(item) for item in items if isinstance(item, dict)]


def _with_policy_names(item: dict[str, Any]) -> dict[str, Any]:
    item = dict(item)
    for policy, names in _POLICY_NAMES.items():
        number = item.get(policy)
        if isinstance(number, int):
            item[policy] = names[number] if 0 <= number < len(names) else 'unknown'
    return item


class _Dumper(yaml.SafeDumper):
    """Block style as yaml-cpp writes it."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        return super().increase_indent(flow, False)

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_representer(
    type(None), lambda dumper, _: dumper.represent_scalar('tag:yaml.org,2002:null', '~')
)
