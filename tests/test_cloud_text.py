"""Text clouds: names, separators, decimal commas and counts are obeyed or refused by line."""

from pathlib import Path

import numpy as np
import pytest

from fgtutor.errors import CloudError
from fgtutor.io.clouds import read_cloud

EAST, NORTH, UP = 500000.5, 4649776.25, 100.125
ONE = [[EAST, NORTH, UP]]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "cloud.xyz"


def read(file: Path, text: str | bytes) -> list:
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_cloud(file).points.tolist()


@pytest.mark.parametrize(
    "text",
    [
        f"{EAST} {NORTH} {UP}",
        f"red,green,x,y,blue,z\n10,20,{EAST},{NORTH},30,{UP}\n",
        f'"Red","Green","X","Y","Blue","Z"\n10,20,{EAST},{NORTH},30,{UP}\n',
        f"y x z\n{NORTH} {EAST} {UP}\n",
        f"id,x,y,z\nA17,{EAST},{NORTH},{UP}\n",
        f"id x y z\nA17 {EAST} {NORTH} {UP}\n",
        f"r g b x y z\n1 2 3 {EAST} {NORTH} {UP}\n",
        f"Z,Y,X\n{UP},{NORTH},{EAST}\n",
        f"Z\tY\tX\n{UP}\t{NORTH}\t{EAST}\n",
        f"Z ; Y ; X\n{UP} ; {NORTH} ; {EAST}\n",
        f"scan angle\tX\tY\tZ\n3\t{EAST}\t{NORTH}\t{UP}\n",
        f"X [m], Y [m], Z [m]\n{EAST}, {NORTH}, {UP}\n",
        f"Y (m) X (m) Z (m)\n{NORTH} {EAST} {UP}\n",
        f"z_m;x_m;y_m\n{UP};{EAST};{NORTH}\n",
        f"Northing Easting Height\n{NORTH} {EAST} {UP}\n",
        f"//X,Y,Z,I\n{EAST},{NORTH},{UP},7\n",
        f"# y x z\n{NORTH} {EAST} {UP}\n",
        f"# red green x y blue z\n1 2 {EAST} {NORTH} 3 {UP}\n",
        f"# the x axis points east, y north and z up\n{EAST} {NORTH} {UP}\n",
        f"# y x z\n# made by hand\n\n{NORTH} {EAST} {UP}\n",
        f"x y z\n1\n{EAST} {NORTH} {UP}\n",
        f"1\n{EAST} {NORTH} {UP} 12 13\n",
        f"\ufeff{EAST} {NORTH} {UP}\n",
        f"\ufeffy x z\n{NORTH} {EAST} {UP}\n",
        f"y x z\r\n{NORTH} {EAST} {UP}\r\n",
        f"{EAST} {NORTH} {UP}\r",
        f"{EAST},{NORTH},{UP},\n",
        f"{EAST};{NORTH};{UP};\n",
        f'"{EAST}","{NORTH}","{UP}"\n',
        f"   {EAST}   {NORTH}\t {UP}  # the only one\n",
        f"{EAST} {NORTH} {UP}\n# the end\n// really\n\n",
        "500000,5;4649776,25;100,125\n",
        "500000,5 4649776,25 100,125\n",
        "500000,5\t4649776,25\t100,125\n",
        "y;x;z\n4649776,25;500000,5;100,125\n",
        "5.000005e5 4.64977625E+06 1.00125e2\n",
        f"{EAST} {NORTH} {UP} tree\n",
        f"{EAST} {NORTH} {UP}\nnan nan nan\n{EAST} -nan(ind) 3\n1.#QNAN 2 3\nNULL N/A -\n",
        f"{EAST},{NORTH},{UP}\n1,,3\n",
    ],
)
def test_what_a_text_says_of_its_columns_is_obeyed(file: Path, text: str) -> None:
    assert read(file, text) == ONE


def test_encodings(file: Path) -> None:
    assert read(file, b"# gemessen in M\xfcnchen\nx y z\n1 2 3\n") == [[1, 2, 3]]
    assert read(file, "\ufeffy x z\r\n1 2 3\r\n".encode("utf-16-le")) == [[2, 1, 3]]
    assert read(file, "\ufeffy x z\n1 2 3\n".encode("utf-16-be")) == [[2, 1, 3]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no line of numbers"),
        ("x y z\n", "no line of numbers"),
        ("# nothing\n\n", "no line of numbers"),
        ("1 2\n3 4\n", r"line 1 has 2 columns.*copy or export it again"),
        ("1 2 3\n4 five 6\n", "line 2: 'five' is no number"),
        ("1 2 3\n\n# x\n4 5\n", "line 4 has 2 columns, expected 3"),
        ("id x y z\n1 2 3 4\n2 3 4\n", "line 3 has 3 columns, expected 4"),
        ("1 2 3\n4 5 6 7\n", "line 2 has 4 columns, expected 3"),
        ("a b c d\n1 2 3 4\n", "names the columns 'a b c d'"),
        ("red green blue\n1 2 3\n", "names the columns"),
        ("x y\n1 2 3\n", "names the columns"),
        ("x y z x\n1 2 3 4\n", "names the columns"),
        ("x y z\n1 2 3 4\n", "names 3 columns, the lines have 4"),
        ("x,y,z\n1,5,2,5,3,5\n", "names 3 columns, the lines have 6"),
        ("lon lat h\n6.1 49.6 300\n", "names the columns"),
        ("# lon lat h\n6.1 49.6 300\n", "degrees"),
        ("# Latitude,Longitude,Altitude\n49.6,6.1,300\n", "degrees"),
        ("x [ft] y [ft] z [ft]\n1 2 3\n", "x in 'ft': convert to metres"),
        ("x_m y_m z_cm\n1 2 3\n", "z in 'cm': convert to metres"),
        ("500000,5,4649776,5,100,1\n", "line 1 may hold decimal commas"),
        ("1,5 2,5 3,5\n4,5 5;5 6,5\n", "line 2: '5;5' is no number"),
        ("1;2;3\n1.234,5;2;3\n", "line 2: '1.234.5' is no number"),
        ("3\n1 2 3\n4 5 6\n", "promises 3 points and 2 are there"),
        ("1\n1 2 3\n4 5 6\n", "more points than its header says, 2 instead of 1"),
        ("1 2 3\n4 1_0 6\n", "line 2: '1_0' is no number"),
        ("1 2 3\n4 0x10 6\n", "line 2: '0x10' is no number"),
        ("1 2 3\n4 \x1b[31m 6\n", r"line 2: '\\x1b\[31m' is no number"),
        ("nan nan nan\n", "none of the 1 points is finite"),
    ],
)
def test_what_cannot_be_told_is_refused_with_its_line(file: Path, text: str, message: str) -> None:
    with pytest.raises(CloudError, match=message):
        read(file, text)


def test_lines_are_counted_over_many_blocks(file: Path) -> None:
    rows = [f"{n} {n / 2} 1" for n in range(250_000)]
    file.write_text("\n".join(rows))
    assert len(read_cloud(file).points) == 250_000
    rows[230_000] = "nan 1 2"
    file.write_text("\n".join(rows))
    read = read_cloud(file)
    assert read.notes == ("1 point not finite",)
    np.testing.assert_array_equal(read.points[-1], [249_999, 124_999.5, 1])
    rows[240_000] = "1 2"
    file.write_text("\n".join(rows))
    with pytest.raises(CloudError, match="line 240001 has 2 columns"):
        read_cloud(file)
