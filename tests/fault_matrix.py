"""What may be wrong with what a case brings, and what then happens: one row a fault, each covered by marked tests.

A test that covers a row carries ``@pytest.mark.fault("D01")``. ``test_fault_matrix.py`` sees that every row is covered,
``make docs`` writes the table into ``docs/faults.md``.
"""

from __future__ import annotations

from typing import NamedTuple


class Row(NamedTuple):
    """A fault and its outcome.

    Attributes
    ----------
    fault : str
    outcome : str
        What the program does.
    limit : str
        What it cannot do; empty where nothing is left open.
    """

    fault: str
    outcome: str
    limit: str = ""


ROWS: dict[str, Row] = {
    "D01": Row("slices missing inside the series", "refused, with the places on both sides of the gap"),
    "D02": Row(
        "slices missing at an end",
        "a warning where the series says how many images it has, a note where their numbers begin late; refused where "
        "a list of checksums came along",
        "without any of these nothing shows it but the length of the shafts",
    ),
    "D03": Row("the same slice twice", "one is set aside by name"),
    "D04": Row("two different slices at one place", "refused"),
    "D05": Row("two series in the folder", "refused, with the number of slices of each"),
    "D06": Row("a scout in the series", "set aside by name"),
    "D07": Row("two patients under one series", "refused, without naming either"),
    "D08": Row("uneven spacing", "below 0.01 mm nothing, to 0.1 mm a warning, beyond refused"),
    "D09": Row("gantry tilt", "refused, with the angle"),
    "D10": Row("any orientation of the patient and of the slices", "the same volume to the bit"),
    "D11": Row("position, orientation or pixel spacing absent or senseless", "refused, naming tag and file"),
    "D12": Row("rescale absent, different or senseless", "refused, naming tag and file"),
    "D13": Row("slice thickness that is not true", "not used"),
    "D14": Row("colour, palette, inverted grey", "refused"),
    "D15": Row("padding values", "become air"),
    "D16": Row("transfer syntaxes", "the same volume to the bit; lossy ones with a warning; HTJ2K refused by name"),
    "D17": Row("deflated files, deflate bombs", "refused before anything is inflated"),
    "D18": Row("files cut, empty, or of another kind", "refused, naming the file"),
    "D19": Row(
        "bits turned in pixels",
        "refused where a list of checksums came along; a warning where a voxel becomes brighter than bone",
        "a small change of a voxel cannot be seen",
    ),
    "D20": Row("bits turned in headers", "refused, or the same volume"),
    "D21": Row("sizes that are not true", "refused before anything is allocated"),
    "D22": Row("ten thousand large slices, too many files", "refused by the headers"),
    "D23": Row("streams made to crash a decoder", "the case is refused; nothing else is touched"),
    "D24": Row("files that are no slices", "set aside by name"),
    "D25": Row("nested folders, links, loops, pipes, unreadable files", "read, left out or refused; never waited for"),
    "D26": Row("a file that changes while it is read", "refused: still being copied"),
    "D27": Row("enhanced multi-frame CT", "refused by that name"),
    "D28": Row("texts of any kind in any tag", "no effect; none of them leaves intake"),
    "D29": Row("a program in the preamble", "ignored"),
    "D30": Row("an archive instead of a folder", "refused: unpack it"),
    "V01": Row("files cut, damaged or with something appended", "refused"),
    "V02": Row("two candidates under one name", "refused: which one is meant is not guessed"),
    "V03": Row("a volume without orientation", "refused"),
    "V04": Row("two orientations that differ", "refused, naming both"),
    "V05": Row("sheared axes", "refused beyond 1e-4"),
    "V06": Row("left-handed axes", "put right together with the voxels; the same volume as the right-handed twin"),
    "V07": Row("metres or micrometres", "refused, with the guess"),
    "V08": Row("a matrix or voxels that are no numbers", "refused"),
    "V09": Row("more or fewer than three axes", "one volume is taken, others refused"),
    "V10": Row("labels as fractions, negative, scaled", "whole numbers are taken with a note, others refused"),
    "V11": Row(
        "labels on another grid than the CT: moved, flipped, another frame of reference",
        "the grids may differ; labels more than 2 mm off the bone are refused, with the way or what an export did to "
        "them, from 0.75 mm on a warning",
        "below about 0.3 mm nothing is seen",
    ),
    "V12": Row(
        "labels of another patient",
        "refused: they do not lie on bone",
        "those of a knee of the same size at the same place may pass",
    ),
    "V13": Row("labels missing, empty or unknown", "required ones refused, others noted"),
    "V14": Row("bones that touch or are exchanged", "exchanged refused, touching a warning"),
    "V15": Row("islands, holes", "removed and filled below 1 %, listed; beyond a warning"),
    "V16": Row("a bone cut by the field of view", "a warning, with the area"),
    "V17": Row("thick slices", "a warning above a ratio of 4"),
    "V18": Row("the side declared wrong, or the data mirrored", "refused where the fibula or the condyles tell it"),
    "V19": Row("two legs in one volume", "the declared side is taken, with a note"),
    "V20": Row("metal, CT numbers cut off", "a warning, with its volume"),
    "V21": Row("headers that point to other files", "refused"),
    "V22": Row("compression bombs, sizes beyond reason", "refused before anything is inflated or allocated"),
    "V23": Row("segmentations with layers or offsets", "offsets are followed; overlapping layers refused"),
    "I01": Row("IDs that are paths, options, device names, blanks, other alphabets", "refused before anything is made"),
    "I02": Row("commands typed as an ID or a folder", "text like any other; nothing is run"),
    "I04": Row("IDs that differ only in upper and lower case", "the second is refused"),
    "I05": Row(
        "lists of cases: encodings, separators, formula cells, an ID or a folder twice, missing folders",
        "read, or refused with the line before anything begins; 0012 stays 0012",
    ),
    "S03": Row("SIGTERM or Ctrl-C at any time", "the case and all that it started end; the same command goes on"),
    "S06": Row("the disk fills", "nothing new is begun, three equal faults stop a batch; nothing finished is lost"),
    "S09": Row("the same batch started twice", "the second waits, then finds all done"),
    "S12": Row(
        "clocks that differ, times in the future", "a batch whose list changed runs again, whatever the clocks say"
    ),
    "S16": Row(
        "the command, the engine or a job killed by SIGKILL",
        "the same command brings every case to its result; what was finished is not computed again",
    ),
    "S17": Row(
        "a case that crashes, hangs, takes all memory, floods the screen, leaves processes",
        "stopped at its limits with a reason; nothing of it lives on, the next case is not touched",
        "a process that changes its user cannot be stopped by us",
    ),
    "X12": Row("texts that a spreadsheet takes for formulas", "a leading apostrophe; numbers stay numbers"),
}
