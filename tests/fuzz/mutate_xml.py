"""Mutations of XML, MJCF above all: attributes, elements, names, what an element is inside of."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from random import Random

_ATTRIBUTES = (
    *("", "x", "0", "-1", "1", "1e-12", "1e6", "1e300", "-1e300", "1e999", "nan", "inf", "-inf", "0 0 0", "0 0 0 0"),
    *("1 2", "1 2 3", "1 2 3 4 5 6 7", "nan nan nan", "1e20 1e20 1e20", "true", "false", "auto", "2147483648", "-5 5"),
    *("5 -5", "é", "a/b", "../x", "q" * 300, "0.1 0.1 0.1", "hinge", "free", "ball", "slide", "mesh", "box", "plane"),
    *("99999999999999999999", "0.5abc", "1,2,3", "&#10;", "1" + " 1" * 2000),
)
_ELEMENTS = (
    *('<include file="missing.xml"/>', '<include file="{self}"/>', "<plugin/>", "<unknown/>", "<worldbody/>"),
    '<extension><plugin plugin="mujoco.pid"/></extension>',
    '<joint name="{name}" type="hinge"/>',
    *('<freejoint/>', '<body name="{name}"/>', '<geom size="1"/>', '<geom type="mesh" mesh="absent"/>', "<default/>"),
    *('<inertial pos="0 0 0" mass="0" diaginertia="0 0 0"/>', '<inertial pos="0 0 0" mass="1" diaginertia="1 1 9"/>'),
    *('<option timestep="0"/>', '<option timestep="1e-9"/>', '<option integrator="RK4"/>', '<option cone="elliptic"/>'),
    *('<compiler angle="degree"/>', '<compiler autolimits="false"/>', '<size nuser_body="5"/>', '<flag gravity="x"/>'),
    *('<position joint="{name}" kp="5"/>', '<motor joint="{name}"/>', '<velocity joint="{name}"/>'),
    *('<general joint="{name}" dyntype="integrator"/>', '<equality><joint joint1="{name}"/></equality>'),
    *('<sensor><jointpos joint="{name}"/></sensor>', '<keyframe><key qpos="1 2 3 4 5 6 7 8 9"/></keyframe>'),
    *('<tendon><fixed><joint joint="{name}" coef="1"/></fixed></tendon>', '<replicate count="3"><site/></replicate>'),
    *('<composite type="cable" count="3 1 1" size="1"/>', '<flexcomp name="f" type="grid" count="3 3 1"/>'),
    *("<asset><mesh name='m' vertex='0 0 0 1 0 0'/></asset>", '<asset><hfield name="h" nrow="2" ncol="2"/></asset>'),
)  # fmt: skip
_HEADS = (
    '<?xml version="1.0" encoding="utf-16"?>',
    '<!DOCTYPE m [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;&b;&b;">]>',
    "<!-- open ", "\x00", "text ",
)  # fmt: skip


def mutate_xml(random: Random, content: bytes, name: str = "model.xml") -> bytes:
    """One to three changes of attributes and elements; name: of the file, which may include itself."""
    root = ElementTree.fromstring(content)
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        root = random.choice(_XML)(random, root, name)
    text = ElementTree.tostring(root, encoding="unicode")
    if random.random() < 0.03:
        text = random.choice(_HEADS) + text
    if random.random() < 0.01:
        text = text.replace("</worldbody>", "<body>" * 5000 + "</body>" * 5000 + "</worldbody>")
    return text.encode("utf-8", errors="surrogatepass")


def _pick(random: Random, root: ElementTree.Element) -> ElementTree.Element:
    return random.choice(list(root.iter()))


def _with_attributes(random: Random, root: ElementTree.Element) -> ElementTree.Element:
    return random.choice([e for e in root.iter() if e.attrib] or [root])


def _attribute(random: Random, root: ElementTree.Element, name: str) -> ElementTree.Element:
    element = _with_attributes(random, root)
    if element.attrib:
        element.set(random.choice(list(element.attrib)), random.choice(_ATTRIBUTES))
    return root


def _without_attribute(random: Random, root: ElementTree.Element, name: str) -> ElementTree.Element:
    element = _with_attributes(random, root)
    if element.attrib:
        del element.attrib[random.choice(list(element.attrib))]
    return root


def _foreign_attribute(random: Random, root: ElementTree.Element, name: str) -> ElementTree.Element:
    """An attribute that another element has."""
    known = sorted({a for e in root.iter() for a in e.attrib})
    _pick(random, root).set(random.choice([*known, "bogus"]), random.choice(_ATTRIBUTES))
    return root


def _same_name(random: Random, root: ElementTree.Element, name: str) -> ElementTree.Element:
    named = [e for e in root.iter() if "name" in e.attrib]
    if named:
        random.choice(named).set("name", random.choice(named).get("name", ""))
    return root


def _number(random: Random, root: ElementTree.Element, name: str) -> ElementTree.Element:
    """One of an attribute's numbers made huge, tiny, negative or none."""
    element = _with_attributes(random, root)
    numbers = [a for a, v in element.attrib.items() if v and v.split()[:1] and v.split()[0].lstrip("-+.")[:1].isdigit()]
    if numbers:
        key = random.choice(numbers)
        words = element.attrib[key].split()
        words[random.randrange(len(words))] = random.choice(_ATTRIBUTES[:13])
        element.set(key, " ".join(words))
    return root


def _without_element(random: Random, root: ElementTree.Element, name: str) -> ElementTree.Element:
    parent = random.choice([e for e in root.iter() if len(e)] or [root])
    if len(parent):
        parent.remove(random.choice(list(parent)))
    return root


def _element_again(random: Random, root: ElementTree.Element, name: str) -> ElementTree.Element:
    """A copy of an element somewhere else, nested wrongly most often."""
    copy = ElementTree.fromstring(ElementTree.tostring(_pick(random, root)))
    _pick(random, root).append(copy)
    return root


def _other_tag(random: Random, root: ElementTree.Element, name: str) -> ElementTree.Element:
    _pick(random, root).tag = random.choice([*sorted({e.tag for e in root.iter()}), "bogus"])
    return root


def _new_element(random: Random, root: ElementTree.Element, name: str) -> ElementTree.Element:
    joints = [e.get("name", "") for e in root.iter("joint")] or ["joint"]
    text = random.choice(_ELEMENTS).replace("{self}", name).replace("{name}", random.choice(joints))
    _pick(random, root).append(ElementTree.fromstring(text))
    return root


_Xml = Callable[[Random, ElementTree.Element, str], ElementTree.Element]
_XML: tuple[_Xml, ...] = (
    *(_attribute, _attribute, _number, _number, _without_attribute, _foreign_attribute, _same_name),
    *(_without_element, _element_again, _other_tag, _new_element, _new_element),
)
