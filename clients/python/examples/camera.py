"""Writes an image of a camera to a PNG file: python camera.py grpc://127.0.0.1:50051 /camera/image_raw shot.png"""

from __future__ import annotations

import struct
import sys
import zlib

import sgc

# Bytes of a pixel, kind of colour of PNG, and where red, green and blue are.
ENCODINGS = {"rgb8": (3, 2, None), "bgr8": (3, 2, (2, 1, 0)), "mono8": (1, 0, None), "rgba8": (4, 6, None)}


def png(image: sgc.Message) -> bytes:
    """A ``sensor_msgs/msg/Image`` as PNG."""
    if image.encoding not in ENCODINGS:
        raise ValueError(f"images in {image.encoding} are not for this example")
    channels, colour, order = ENCODINGS[image.encoding]
    rows = bytearray()
    for row in range(image.height):
        begin = row * image.step
        line = bytearray(image.data[begin : begin + image.width * channels])
        if order:
            line[0::3], line[2::3] = line[order[0] :: 3], line[order[2] :: 3]
        rows += b"\0" + line

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", image.width, image.height, 8, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def main(address: str, topic: str, file: str) -> None:
    with sgc.connect(address) as robot:
        with robot.subscribe(topic, "sensor_msgs/msg/Image", depth=1) as images:
            image = next(images)
    with open(file, "wb") as out:
        out.write(png(image))
    print(f"{image.width} x {image.height} in {image.encoding}: {file}")


if __name__ == "__main__":
    main(*sys.argv[1:4])
