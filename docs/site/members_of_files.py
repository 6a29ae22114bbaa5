"""Puts the free functions that Doxygen lists with their namespace into the XML of their headers, for Breathe to show them there.

    members_of_files.py FOLDER_OF_XML

What is private goes, and so do designated initializers, which Sphinx does not know.
"""

import sys
from pathlib import Path
from xml.etree import ElementTree

folder = Path(sys.argv[1])
trees = {path: ElementTree.parse(path) for path in folder.glob("*.xml")}
by_header = {tree.find("compounddef/location").get("file"): tree for tree in trees.values() if tree.find("compounddef[@kind='file']")}

for path, tree in trees.items():
    for parent in list(tree.iter()):
        for child in list(parent):
            is_private = child.tag == "sectiondef" and child.get("kind").startswith("private-")
            is_designated = child.tag == "initializer" and "".join(child.itertext()).startswith("= {.")
            if is_private or is_designated or child.tag == "innernamespace":
                parent.remove(child)
    if not path.name.startswith("namespacegp2"):
        continue
    for section in tree.findall("compounddef/sectiondef"):
        for member in section:
            place = member.find("location").get("file")
            compound = by_header[place].find("compounddef")
            there = compound.find(f"sectiondef[@kind='{section.get('kind')}']")
            if there is None:
                there = ElementTree.Element("sectiondef", kind=section.get("kind"))
                compound.insert(list(compound).index(compound.find("briefdescription")), there)
            there.append(member)

for path, tree in trees.items():
    tree.write(path, encoding="unicode")
