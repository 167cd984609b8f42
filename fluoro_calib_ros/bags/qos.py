"""Quality of service as it stands in bags: YAML in a channel's metadata and in metadata.yaml."""

import yaml

_INFINITE = {'sec': 9223372036, 'nsec': 854775807}  # RMW_DURATION_INFINITE
# Numbers of the policies, in bags from before Jazzy (rmw/types.h).
_NUMBERED = {
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


def profile(reliability='reliable', durability='volatile', depth=10):
    """A quality of service {policy: value} as rosbag2 writes it; keep last, no deadline, no
    lifespan.
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


def to_yaml(value):
    """YAML text in the form of rosbag2: blocks, keys in their order, no line end behind it."""
    return yaml.dump(
        value, Dumper=_Dumper, sort_keys=False, default_flow_style=False, width=10**6
    ).rstrip('\n')


def parse_profiles(value):
    """Qualities of service [{policy: value}, ...] from the YAML text or list in a bag; policies by
    name.

    What cannot be understood is left out: a bag is readable without it.
    """
    try:
        items = yaml.safe_load(value) if isinstance(value, str) else value
    except yaml.YAMLError:
        return []
    return (
        [_named(item) for item in items if isinstance(item, dict)]
        if isinstance(items, list)
        else []
    )


def _named(item):
    item = dict(item)
    for policy, names in _NUMBERED.items():
        number = item.get(policy)
        if isinstance(number, int):
            item[policy] = names[number] if 0 <= number < len(names) else 'unknown'
    return item


class _Dumper(yaml.SafeDumper):
    """Block style as yaml-cpp writes it."""

    def increase_indent(self, flow=False, indentless=False):
        return super().increase_indent(flow, False)

    def ignore_aliases(self, data):
        return True


_Dumper.add_representer(
    type(None), lambda dumper, _: dumper.represent_scalar('tag:yaml.org,2002:null', '~')
)
