"""Message definitions without ROS: those of Jazzy, and fluoro_calib_msgs from the files in msg/."""

from functools import cache
from importlib.resources import files

from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from ..errors import DataError

PACKAGE = 'fluoro_calib_msgs'
TARGET_OBSERVATIONS = f'{PACKAGE}/msg/TargetObservations'
_SEPARATOR = '=' * 80


@cache
def typestore():
    """The rosbags typestore of Jazzy with the messages of fluoro_calib_msgs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in _own_texts().items():
        store.register(get_types_from_msg(text, name))
    return store


def message_class(msg_type):
    """The dataclass of a message type such as 'std_msgs/msg/Header'. Raises DataError for one not
    known.
    """
    if msg_type not in typestore().types:
        raise DataError(f'the message type {msg_type!r} is not known')
    return typestore().types[msg_type]


@cache
def type_hash(msg_type):
    """Hash 'RIHS01_...' of a message type (REP-2016)."""
    message_class(msg_type)
    return typestore().hash_rihs01(msg_type)


@cache
def full_text(msg_type):
    """Definition of a message type, and behind it those of all types it is made of, as in a bag's
    schema.

    Each has a line of 80 '=' and a line 'MSG: package/Type' before it, in the order in which
    rosbag2 finds them.
    """
    message_class(msg_type)
    return _with_dependencies(msg_type, set())


def to_cdr(message, msg_type):
    """CDR bytes of a message dataclass. Raises DataError where a field has a value it cannot have."""
    message_class(msg_type)
    try:
        return bytes(typestore().serialize_cdr(message, msg_type, little_endian=True))
    except Exception as error:  # generated code: whatever the wrong value brings about
        raise DataError(f'this is not a message of type {msg_type} ({error})') from None


def from_cdr(data, msg_type):
    """Message dataclass of CDR bytes. Raises DataError where they are not a message of that type."""
    message_class(msg_type)
    try:
        return typestore().deserialize_cdr(data, msg_type)
    except Exception as error:  # generated code on bytes that may be anything
        raise DataError(f'the content is not a {msg_type} ({error})') from None


def fields_of(msg_type, text, encoding):
    """Fields of a message type and of those it is made of, {type: fields}, from the definition in
    a bag.

    encoding 'ros2msg' or 'ros2idl'. Raises DataError where the definition cannot be read.
    """
    parse = {
        'ros2msg': get_types_from_msg,
        'ros2idl': lambda text, _: get_types_from_idl(text),
    }.get(encoding)
    if parse is None:
        raise DataError(
            f'the definition of {msg_type} has the encoding {encoding!r}, ros2msg is expected'
        )
    try:
        return {name: fields for name, (_, fields) in parse(text, msg_type).items()}
    except Exception as error:  # a parser on text that may be anything
        raise DataError(
            f'the definition of {msg_type} cannot be read ({type(error).__name__})'
        ) from None


def _own_texts():
    folder = files(__package__) / 'msg'
    return {
        f'{PACKAGE}/msg/{file.name[:-4]}': file.read_text(encoding='utf-8')
        for file in sorted(folder.iterdir(), key=lambda f: f.name)
        if file.name.endswith('.msg')
    }


def _with_dependencies(msg_type, seen):
    store = typestore()
    text = _own_texts().get(msg_type) or store.gendefhash(msg_type, {}, ros_version=2)[0]
    for name in sorted(_parts(store.fielddefs[msg_type][1])):
        if name not in seen:
            seen.add(name)
            text += f'\n{_SEPARATOR}\nMSG: {name.replace("/msg/", "/")}\n' + _with_dependencies(
                name, seen
            )
    return text


def _parts(fields):
    """Names of the message types among fields, looking into arrays."""
    names = set()
    for _, description in fields:
        while isinstance(description[1][0], tuple):  # an array or a sequence of something
            description = description[1][0]
        if isinstance(description[1], str):
            names.add(description[1])
    return names
