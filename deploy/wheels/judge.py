"""Judges whether a wheel's programs run where its tag says.

usage: judge.py WHEEL

Exit code 1 if a program is for another architecture, or if it needs a symbol or library
that not every system of a tag of manylinux has; prints which.
"""

from __future__ import annotations

import collections
import pathlib
import re
import sys
import tempfile
import zipfile

from auditwheel.architecture import Architecture
from auditwheel.libc import Libc
from auditwheel.policy import Policy
from auditwheel.wheel_abi import analyze_wheel_abi
from elftools.elf.elffile import ELFFile
from elftools.elf.gnuversions import GNUVerNeedSection, GNUVerSymSection
from elftools.elf.sections import SymbolTableSection

#: What pyelftools calls the architectures of wheels.
ARCHITECTURES = {"x64": "x86_64", "AArch64": "aarch64"}


def platform_of(wheel: pathlib.Path) -> tuple[str, str]:
    """The platform of a wheel's tag, and its architecture."""
    [(platform, arch)] = re.findall(r"-((?:linux|manylinux_\d+_\d+)_(x86_64|aarch64))$",
                                    wheel.stem)
    return platform, arch


def programs(wheel: pathlib.Path) -> list[tuple[str, ELFFile]]:
    """The programs in a wheel, by their names."""
    found = []
    with zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            if ".data/scripts/" in name:
                # Sections are read later, and by seeking.
                file = tempfile.TemporaryFile()
                file.write(archive.read(name))
                found.append((pathlib.PurePath(name).name, ELFFile(file)))
    return found


def newer_symbols(program: ELFFile, policy: Policy) -> dict[str, list[str]]:
    """The symbols that a program needs in versions which a policy does not have, by
    "LIBRARY VERSION"."""
    needs = program.get_section_by_name(".gnu.version_r")
    versions = program.get_section_by_name(".gnu.version")
    symbols = program.get_section_by_name(".dynsym")
    found: dict[str, list[str]] = collections.defaultdict(list)
    if not (isinstance(needs, GNUVerNeedSection) and
            isinstance(versions, GNUVerSymSection) and
            isinstance(symbols, SymbolTableSection)):
        return found    # A program without shared libraries.
    newer = {}
    for library, wanted in needs.iter_versions():
        for need in wanted:
            base, _, number = need.name.partition("_")
            # The policies do not name what they do not bound.
            if number not in policy.symbol_versions.get(base, [number]):
                newer[need.entry.vna_other] = f"{library.name} {need.name}"
    for version, symbol in zip(versions.iter_symbols(), symbols.iter_symbols()):
        if version.entry.ndx in newer:
            found[newer[version.entry.ndx]].append(symbol.name)
    return found


def judge(wheel: pathlib.Path) -> list[str]:
    """The reasons for which a wheel's programs do not run where its tag says."""
    platform, arch = platform_of(wheel)
    found = programs(wheel)
    reasons = [f"{name} is for {made}, not for {arch}" for name, program in found
               if (made := ARCHITECTURES.get(program.get_machine_arch(),
                                             program.get_machine_arch())) != arch]
    if reasons or platform.startswith("linux_"):
        return reasons
    # Libraries of this machine say nothing about those elsewhere.
    info = analyze_wheel_abi(
        Libc.GLIBC, Architecture(arch), wheel, frozenset(), disable_isa_ext_check=False,
        allow_graft=False, args_ldpaths="")
    wanted = info.policies.get_policy_by_name(platform)
    if not info.overall_policy < wanted:
        return []
    for name, program in found:
        for place, symbols in newer_symbols(program, wanted).items():
            reasons.append(f"{name} needs {', '.join(sorted(symbols))} of {place}")
    lacking = info.external_refs[wanted.name]
    reasons += [f"{library} is needed, and is no library of {wanted.name}"
                for library in sorted(lacking.libs)]
    reasons += [f"{', '.join(sorted(symbols))} of {library} are needed, which not all "
                f"versions of it have"
                for library, symbols in sorted(lacking.blacklist.items())]
    if info.machine_policy < wanted:
        reasons.append(f"the programs need instructions that not every {arch} has")
    return reasons or [f"auditwheel finds no more than {info.overall_policy.name}"]


def main() -> int:
    """Prints the reasons, if there are any."""
    wheel = pathlib.Path(sys.argv[1])
    reasons = judge(wheel)
    for reason in reasons:
        print(f"{wheel.name}: {reason}", file=sys.stderr)
    return 1 if reasons else 0


if __name__ == "__main__":
    sys.exit(main())
