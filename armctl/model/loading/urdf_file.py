"""Reads the XML of a URDF: prefixes may be undeclared, xacro is expanded, entities are refused."""

import importlib
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from xml.parsers import expat

from armctl.core.errors import ModelError
from armctl.core.file_reading import read_bytes, reading, shown_path
from armctl.core.note import Note

_HEAD_BYTES = 65536  # in which the first element of a file is expected
_MAX_BYTES = 100_000_000
_UNIQUE = {"link": ("inertial",), "joint": ("origin", "axis", "limit", "dynamics", "mimic")}
_ZERO_INERTIA = {"ixx": "0", "ixy": "0", "ixz": "0", "iyy": "0", "iyz": "0", "izz": "0"}


@dataclass(frozen=True, eq=False)
class UrdfFile:
    """A URDF as XML."""

    path: Path  # the file; its meshes are searched from here
    root: ElementTree.Element  # the element <robot>, with xacro expanded. Prefixes are part of the names.
    text: str | None = None  # what MuJoCo reads instead of the file; None if it can read the file itself
    notes: tuple[str, ...] = ()  # what was changed in the text, one sentence each


def is_urdf(path: Path) -> bool:
    """Whether a file is a URDF or a xacro: by its name, or because its first element is <robot>."""
    return path.suffix.lower() in (".urdf", ".xacro") or _first_tag(path) == "robot"


def read_urdf_file(path: Path) -> UrdfFile:
    """Reads a URDF, or expands a xacro; ModelError if that is not possible, or a joint is planar."""
    content = model_bytes(path)
    root = parse_xml(content, path)
    text = None
    if any(element.tag.startswith("xacro:") for element in root.iter()):
        text = _expanded(path)
        root = parse_xml(text.encode(), path)
    elif path.suffix.lower() != ".urdf":  # MuJoCo chooses a reader by the ending
        text = content.decode(errors="replace")
    _refuse_planar(root, path)
    notes = [*_drop_repeated(root), *_complete_inertials(root)]
    if notes:
        text = ElementTree.tostring(root, encoding="unicode")
    return UrdfFile(path=path, root=root, text=text, notes=tuple(notes))


def parse_xml(content: bytes, path: Path) -> ElementTree.Element:
    """The root of an XML document whose prefixes need no declaration, as in MuJoCo and other URDF readers.

    ModelError if it is not well-formed, or declares entities, which could expand to gigabytes.
    """

    def refuse_entity(name: str, *_: object) -> None:
        raise ModelError(f"{shown_path(path)}: it declares the XML entity {name!r:.80}; write the text itself instead")

    builder = ElementTree.TreeBuilder()
    try:
        parser = expat.ParserCreate()  # without a separator, expat leaves namespaces alone
        parser.buffer_text = True
        parser.StartElementHandler = builder.start
        parser.EndElementHandler = builder.end
        parser.CharacterDataHandler = builder.data
        parser.EntityDeclHandler = refuse_entity
        parser.Parse(content.lstrip(), True)
        return builder.close()
    except (expat.ExpatError, LookupError) as error:
        raise ModelError(f"{shown_path(path)}: no well-formed XML: {error}") from None


def model_bytes(path: Path) -> bytes:
    """The content of a URDF, xacro or SRDF; ModelError if it cannot be read."""
    with reading(path, "no model", ModelError):
        return read_bytes(path, _MAX_BYTES)


def _first_tag(path: Path) -> str:
    """The name of a document's first element; empty if there is none."""
    tags: list[str] = []
    parser = expat.ParserCreate()
    parser.StartElementHandler = lambda tag, _attributes: tags.append(tag)
    try:
        with path.open("rb") as file:
            parser.Parse(file.read(_HEAD_BYTES).lstrip(), False)
    except (expat.ExpatError, OSError, LookupError):
        pass  # MuJoCo reports what is wrong; elements before the error count
    return tags[0] if tags else ""


def _expanded(path: Path) -> str:
    """The URDF of a xacro; ModelError if xacrodoc is not installed or cannot expand it."""
    try:
        xacrodoc = importlib.import_module("xacrodoc")
    except ImportError:
        raise ModelError(
            f"{shown_path(path)}: a xacro, which must be expanded to a URDF: `pip install xacrodoc` lets armctl do it, "
            f"or run `xacro FILE -o robot.urdf` of ROS"
        ) from None
    try:
        document = xacrodoc.XacroDoc.from_file(str(path), resolve_packages=False)
        return document.to_urdf_string()
    except Exception as error:  # xacro evaluates expressions of the file, which can raise anything
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ModelError(f"{shown_path(path)}: xacrodoc cannot expand it: {reason:.200}") from None


def _refuse_planar(root: ElementTree.Element, path: Path) -> None:
    """Refuses planar joints: three degrees of freedom, for which a URDF has neither three limits nor three motors."""
    for joint in root.findall("joint"):
        if joint.get("type") == "planar":
            name = joint.get("name", "")
            raise ModelError(
                f"{shown_path(path)}: joint {name!r:.80} is planar and has three degrees of freedom, without a motor for each; "
                'write type="fixed" to hold it, or two prismatic joints and a continuous one'
            )


def _drop_repeated(root: ElementTree.Element) -> list[str]:
    """Keeps the first of elements that a link or joint has once, as other URDF readers do; one sentence, or none."""
    names = []
    for parent in (*root.findall("link"), *root.findall("joint")):
        for tag in _UNIQUE[parent.tag]:
            for repeated in parent.findall(tag)[1:]:
                parent.remove(repeated)
                names.append(f"<{tag}> of {parent.get('name', '')}")
    return [f"repeated elements are left out: {', '.join(names):.200}"] if names else []


def _complete_inertials(root: ElementTree.Element) -> list[str]:
    """Adds the elements of an <inertial> that MuJoCo demands, as zeros; one sentence, or none."""
    names = []
    for link in root.findall("link"):
        inertial = link.find("inertial")
        if inertial is None:
            continue
        if inertial.find("inertia") is not None and inertial.find("mass") is not None:
            continue
        names.append(link.get("name", ""))
        if inertial.find("mass") is None:
            link.remove(inertial)
        else:
            inertial.append(ElementTree.Element("inertia", _ZERO_INERTIA))
    advice = 'write <mass value="..."/> and <inertia .../> into the <inertial> of these links'
    return [Note(f"the inertial of {', '.join(names):.200} has no mass or no inertia", advice)] if names else []
