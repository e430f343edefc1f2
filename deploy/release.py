"""Judges whether a tree is one of a release, and gathers what was built of it.

usage: release.py check
       release.py gather ARCH...

deploy/release runs it, and says what both do. `check` needs nothing but Python.
"""

from __future__ import annotations

import datetime
import email
import hashlib
import pathlib
import re
import shutil
import sys
import tarfile
import tempfile
import uuid
import zipfile
from collections.abc import Iterator

ROOT = pathlib.Path(__file__).resolve().parent.parent
#: Where the version stands: files, and what is around it there.
PLACES = (
    ("CMakeLists.txt", r"^project\(revisit VERSION (\S+)"),
    ("client/python/revisit/_version.py", r'^__version__ = "(.*)"'),
    ("client/python/pyproject.toml", r'"revisit-server==(.*)"'),
    ("client/console/package.json", r'"name": "revisit-console",\s+"version": "(.*)"'),
    # Twice there.
    ("client/console/package-lock.json",
     r'"name": "revisit-console",\s+"version": "(.*)"'),
    ("deploy/chart/Chart.yaml", r"^version: (.*)"),
    ("deploy/chart/Chart.yaml", r'^appVersion: "(.*)"'),
)


class Refused(Exception):
    """What is wrong with a release, in lines."""


def version_of_tree() -> str:
    """The version of the CMake project, with which all other places have to agree."""
    path, pattern = PLACES[0]
    return re.search(pattern, (ROOT / path).read_text(), re.MULTILINE)[1]


def check() -> str:
    """The version of a tree that is one of a release."""
    version = version_of_tree()
    wrong = []
    for path, pattern in PLACES:
        found = re.findall(pattern, (ROOT / path).read_text(), re.MULTILINE)
        if not found:
            wrong.append(f"{path}: no version where it was to be: {pattern}")
        wrong += [f"{path}: the version is {other}, and {version} in {PLACES[0][0]}"
                  for other in found if other != version]
    try:
        date_of(version)
    except Refused as error:
        wrong.append(str(error))
    if wrong:
        raise Refused("\n".join(wrong))
    return version


def date_of(version: str) -> datetime.date:
    """The day of a version's section, which has to be the first of CHANGELOG.md."""
    text = (ROOT / "CHANGELOG.md").read_text()
    sections = re.findall(r"^## (.*)\n((?:(?!## ).*\n)*)", text, re.MULTILINE)
    if sections and sections[0][0] == "Unreleased":
        if sections[0][1].strip():
            raise Refused("CHANGELOG.md: Unreleased has text: its heading was to be "
                          f"'## {version} - YYYY-MM-DD'")
        del sections[0]
    heading = sections[0][0] if sections else "no section"
    found = re.fullmatch(re.escape(version) + r" - (\d{4}-\d\d-\d\d)", heading)
    if not found:
        raise Refused(f"CHANGELOG.md: the newest section was to be "
                      f"'## {version} - YYYY-MM-DD', and is '{heading}'")
    try:
        return datetime.date.fromisoformat(found[1])
    except ValueError as error:
        raise Refused(f"CHANGELOG.md: '{heading}' has no date: {error}") from error


def files_of(version: str, architectures: list[str]) -> list[pathlib.Path]:
    """The files of a release, which the commands of docs/release.md have made."""
    wanted = [("build/wheels", f"revisit-{version}.tar.gz", "deploy/wheels/build"),
              ("build/wheels", f"revisit-{version}-*.whl", "deploy/wheels/build")]
    for arch in architectures:
        wanted += [
            ("build/wheels", f"revisit_server-{version}-*-manylinux_*_{arch}.whl",
             f"deploy/wheels/build --arch {arch}"),
            ("build/portable", f"revisit-{version}-linux-{arch}.tar.gz",
             f"deploy/portable/build --arch {arch}")]
    # Those of one architecture, that of the machine, on which they are built.
    wanted += [("build/release/packages", f"{name}_{version}-*.deb", "cpack")
               for name in ("revisit", "revisit-server", "librevisit-dev")]
    found, missing = [], []
    for folder, pattern, command in wanted:
        here = sorted((ROOT / folder).glob(pattern))
        found += here
        if not here:
            missing.append(f"{folder}/{pattern} is missing: {command} makes it")
    if missing:
        raise Refused("\n".join(missing))
    return found


def programs_in(path: pathlib.Path) -> Iterator[bytes]:
    """The programs in a wheel or an archive."""
    if path.suffix == ".whl":
        with zipfile.ZipFile(path) as wheel:
            for name in wheel.namelist():
                if ".data/scripts/" in name:
                    yield wheel.read(name)
    elif path.suffix == ".gz":
        with tarfile.open(path) as archive:
            for member in archive:
                if re.search(r"/bin/revisitd?$", member.name) and member.isfile():
                    yield archive.extractfile(member).read()


def check_commits(version: str, files: list[pathlib.Path]) -> None:
    """All programs say that they are of one commit and of this version."""
    builds: dict[str, set[str]] = {}
    for path in files:
        for program in programs_in(path):
            found = re.search(
                rb"(\d+\.\d+\.\d+) \((?:commit ([\w-]+), )?built ", program)
            build = "an unknown version"
            if found:
                build = b" of commit ".join(found.groups(b"unknown")).decode()
            builds.setdefault(build, set()).add(path.name)
    wrong = [f"{', '.join(sorted(names))}: programs of {build}"
             for build, names in sorted(builds.items())]
    if len(builds) != 1:
        raise Refused("the programs are not of one build:\n" + "\n".join(wrong))
    [build] = builds
    if not re.fullmatch(re.escape(version) + " of commit [0-9a-f]+", build):
        raise Refused(f"the programs are not those of {version} and of a commit "
                      "without changes:\n" + "\n".join(wrong))


def libraries_in(wheel: pathlib.Path) -> list[tuple[str, str]]:
    """Names and versions of the libraries that are linked into the programs of a wheel,
    as their licences are named: NAME-VERSION, or NAME where nobody knows more."""
    with zipfile.ZipFile(wheel) as archive:
        names = {found[1] for name in archive.namelist() if (
            found := re.search(r"/licenses/third-party/([^/]+)", name))}
    return [re.fullmatch(r"(.+?)(?:-(\d[^/]*))?", name).groups("")
            for name in sorted(names)]


def requirements_of(wheel: pathlib.Path) -> list[str]:
    """The packages that pip installs with a wheel, without those of extras."""
    with zipfile.ZipFile(wheel) as archive:
        [name] = [name for name in archive.namelist()
                  if name.endswith(".dist-info/METADATA")]
        fields = email.message_from_bytes(archive.read(name))
    wanted = fields.get_all("Requires-Dist", [])
    return sorted({re.match(r"[\w.-]+", one)[0] for one in wanted
                   if "extra ==" not in one})


def digest(path: pathlib.Path) -> str:
    """The SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def bill_of_materials(version: str, date: datetime.date,
                      files: list[pathlib.Path]) -> str:
    """The release with its files, the libraries in its programs, and the packages that
    the client for Python asks for, as CycloneDX; the same text for the same files."""
    from cyclonedx.model import HashAlgorithm, HashType
    from cyclonedx.model.bom import Bom, BomMetaData
    from cyclonedx.model.component import Component, ComponentType
    from cyclonedx.output.json import JsonV1Dot6
    from cyclonedx.schema import SchemaVersion
    from cyclonedx.validation.json import JsonStrictValidator
    from packageurl import PackageURL

    def component(kind: ComponentType, name: str, **fields: object) -> Component:
        reference = f"{kind.value}:{name}"
        return Component(type=kind, name=name, bom_ref=reference, **fields)

    whole = component(ComponentType.APPLICATION, "revisit", version=version)
    parts = [component(ComponentType.FILE, path.name, hashes=[
        HashType(alg=HashAlgorithm.SHA_256, content=digest(path))]) for path in files]
    servers = [path for path in files if path.name.startswith("revisit_server-")]
    linked = {name: component(ComponentType.LIBRARY, name, version=number or None)
              for wheel in servers for name, number in libraries_in(wheel)}
    [client] = [path for path in files
                if path.name == f"revisit-{version}-py3-none-any.whl"]
    asked = [component(ComponentType.LIBRARY, name,
                       purl=PackageURL(type="pypi", name=name.lower()))
             for name in requirements_of(client)]
    libraries = [*linked.values(), *asked]
    bom = Bom(
        serial_number=uuid.uuid5(uuid.NAMESPACE_OID, "\n".join(map(digest, files))),
        metadata=BomMetaData(component=whole, timestamp=datetime.datetime.combine(
            date, datetime.time(), datetime.timezone.utc)),
        components=[*parts, *libraries])
    bom.register_dependency(whole, parts)
    for part in parts:
        bom.register_dependency(part, asked if part.name == client.name else (
            linked.values() if part.name in {path.name for path in servers} else ()))
    text = JsonV1Dot6(bom).output_as_string(indent=2)
    problem = JsonStrictValidator(SchemaVersion.V1_6).validate_str(text)
    if problem:
        raise Refused(f"the bill of materials is invalid: {problem}")
    return text + "\n"


def gather(architectures: list[str]) -> pathlib.Path:
    """The folder of a release with all its files."""
    version = check()
    files = files_of(version, architectures)
    check_commits(version, files)
    place = ROOT / f"build/release-{version}"
    with tempfile.TemporaryDirectory(dir=ROOT / "build") as made:
        folder = pathlib.Path(made) / "release"
        folder.mkdir()
        for path in files:
            shutil.copy(path, folder)
        (folder / f"revisit-{version}.cdx.json").write_text(
            bill_of_materials(version, date_of(version), files))
        (folder / "SHA256SUMS").write_text("".join(
            f"{digest(path)}  {path.name}\n" for path in sorted(folder.iterdir())))
        shutil.rmtree(place, ignore_errors=True)
        folder.rename(place)
    return place


def main(arguments: list[str]) -> int:
    """Does what is asked for, and says what came of it."""
    try:
        if arguments == ["check"]:
            version = check()
            print(f"release: {version} of {date_of(version)}: all places agree")
        else:
            place = gather(arguments[1:])
            for path in sorted(place.iterdir()):
                print(path.relative_to(ROOT))
    except Refused as error:
        for line in str(error).splitlines():
            print(f"release: {line}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
