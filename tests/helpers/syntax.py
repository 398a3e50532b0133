"""Syntax trees of source files: each is parsed and walked once, whichever tests read it."""

import ast
import inspect
from collections.abc import Callable
from functools import cache
from pathlib import Path


@cache
def tree_of_text(text: str) -> ast.Module:
    """The syntax tree of a module's text, which nobody changes."""
    return ast.parse(text)


@cache
def nodes_of_text(text: str) -> tuple[ast.AST, ...]:
    """All nodes of a module's text."""
    return tuple(ast.walk(tree_of_text(text)))


def definition_of(value: type | Callable[..., object]) -> ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef:
    """The node that defines a class or a function: of several of one name, such as overloads, the last."""
    value = inspect.unwrap(value)
    return _definitions(Path(inspect.getfile(value)).read_text(encoding="utf-8"))[value.__qualname__]


@cache
def _definitions(text: str) -> dict[str, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef]:
    """Classes and functions of a module, and those inside classes, by their qualified names."""
    found = {}
    waiting = [("", tree_of_text(text).body)]
    while waiting:
        prefix, body = waiting.pop()
        for node in body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                found[f"{prefix}{node.name}"] = node
            if isinstance(node, ast.ClassDef):
                waiting.append((f"{prefix}{node.name}.", node.body))
            elif isinstance(node, ast.If | ast.Try):
                waiting.append((prefix, [*node.body, *node.orelse]))
    return found
