"""Decompress the points of a LAZ file in a process of its own: some damaged files abort lazrs.

Run by path, without fgtutor and without site packages, so that it starts at once: reads the file on
its standard input, writes point records to its standard output. Its arguments are the folder of
lazrs, where the points begin, how many there are, their size, the LASzip record in hexadecimal
digits, and how many bytes of memory and seconds it may take.
"""

import sys

_BLOCK = 2**16


def main() -> None:
    """Decompress; on a fault one line on standard error tells why."""
    folder, start, count, size, record, memory, seconds = sys.argv[1:]
    try:
        import resource  # not on Windows
    except ImportError:
        pass
    else:
        for limit, value in (
            (resource.RLIMIT_AS, int(memory)),
            (resource.RLIMIT_CPU, int(seconds)),
            (resource.RLIMIT_CORE, 0),
        ):
            hard = resource.getrlimit(limit)[1]
            value = value if hard == resource.RLIM_INFINITY else min(value, hard)
            resource.setrlimit(limit, (value, hard))
    sys.path.append(folder)
    import lazrs

    with open(0, "rb") as source, open(1, "wb") as out:
        source.seek(int(start))
        reader = lazrs.LasZipDecompressor(source, bytes.fromhex(record))  # pyright: ignore
        for done in range(0, int(count), _BLOCK):
            block = bytearray(min(_BLOCK, int(count) - done) * int(size))
            reader.decompress_many(block)
            out.write(block)


if __name__ == "__main__":
    try:
        main()
    except BaseException as error:  # Rust's panics are no Exception
        sys.exit(f"{type(error).__name__}: {error}")
