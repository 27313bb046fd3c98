# SPDX-License-Identifier: Apache-2.0
"""A digest of a pickled policy that is the same in every process.

The bytes of a pickle depend on more than the pickled object: sets have a different
order in each process, equal strings are stored once or twice, and cloudpickle adds
random class names and the submodules that happen to be imported. This digest covers the
object itself. Nothing is unpickled, so no code of the policy runs.
"""

from __future__ import annotations

import hashlib
import itertools
import pickletools
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any

# Opcodes that change the object on top of the stack instead of pushing a new one.
_CHANGES = {"APPEND", "APPENDS", "SETITEM", "SETITEMS", "ADDITEMS", "BUILD"}
_UNORDERED = {"ADDITEMS", "FROZENSET"}
# Objects with an identity: sharing one is not the same as having two equal ones.
_MUTABLE = {
    "EMPTY_LIST",
    "EMPTY_DICT",
    "EMPTY_SET",
    "BYTEARRAY8",
    "REDUCE",
    "NEWOBJ",
    "NEWOBJ_EX",
}
# What a function or a class has collected in this process: cloudpickle's list of
# imported submodules, and what `copyreg` notes when an instance is pickled.
_OF_PROCESS = ("_cloudpickle_submodules", "__slotnames__")


@dataclass(eq=False, slots=True)
class _Node:
    """An object that a pickle describes, or a change to one.

    Attributes:
        opcode: the name of the opcode that builds it.
        value: the argument of the opcode.
        parts: the objects that it is built from, then the changes made to it.
    """

    opcode: str
    value: Any
    parts: list[_Node]


def pickle_digest(payload: bytes, *, ignored: AbstractSet[str] = frozenset()) -> str:
    """Return the SHA-256 of the object that a pickle of protocol 4 or 5 describes.

    Args:
        payload: the pickle.
        ignored: strings that differ from process to process, and are left out.
    """
    return _digest(_parse(payload), ignored, {}).hex()


def _parse(payload: bytes) -> list[_Node]:
    """Return the pickled object, then the calls whose results are not used."""
    stack: list[_Node] = []
    below_marks: list[list[_Node]] = []
    memo: dict[Any, _Node] = {}
    calls: list[_Node] = []
    for opcode, value, _ in pickletools.genops(payload):
        name, needs = opcode.name, opcode.stack_before
        if name in ("PROTO", "FRAME", "STOP"):
            continue
        if name == "MARK":
            below_marks.append(stack)
            stack = []
        elif name == "MEMOIZE":
            memo[len(memo)] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(memo[value])
        elif name == "POP":
            calls.append(stack.pop())
        else:
            if pickletools.markobject in needs:
                parts, stack = stack, below_marks.pop()
            else:
                first = len(stack) - len(needs) + (name in _CHANGES)
                parts = stack[first:]
                del stack[first:]
            if name == "BUILD" and _is_empty_dict(parts[0]):
                # Some objects get their `__dict__` only when it is first read.
                continue
            if name in _CHANGES:
                stack[-1].parts.append(_Node(name, value, parts))
            elif name != "POP_MARK":
                stack.append(_Node(name, value, parts))
    return [*stack, *calls]


def _is_empty_dict(node: _Node) -> bool:
    return node.opcode == "EMPTY_DICT" and not node.parts


def _digest(
    roots: list[_Node], ignored: AbstractSet[str], numbers: dict[_Node, int]
) -> bytes:
    """Return the SHA-256 of objects.

    Args:
        roots: the objects.
        ignored: see `pickle_digest`.
        numbers: the mutable objects seen so far, with their numbers; it is extended.
    """
    hashed = hashlib.sha256()
    # A stack instead of recursion, because policies can be nested deeply.
    left = roots[::-1]
    while left:
        node = left.pop()
        if node in numbers:
            hashed.update(f"same {numbers[node]};".encode())
            continue
        if node.opcode in _MUTABLE:
            numbers[node] = len(numbers)
        value, parts = node.value, node.parts
        if isinstance(value, str) and value in ignored:
            value = None
        if node.opcode == "SETITEMS":
            pairs = zip(parts[::2], parts[1::2], strict=True)
            kept = (pair for pair in pairs if pair[0].value not in _OF_PROCESS)
            parts = list(itertools.chain.from_iterable(kept))
        data = value if isinstance(value, bytes | bytearray) else repr(value).encode()
        hashed.update(f"{node.opcode} {len(data)} {len(parts)};".encode())
        hashed.update(data)
        if node.opcode in _UNORDERED:
            # Each with the numbers so far, because the order is not known yet.
            for each in sorted(_digest([part], ignored, {**numbers}) for part in parts):
                hashed.update(each)
        else:
            left += parts[::-1]
    return hashed.digest()
