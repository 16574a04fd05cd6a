"""Runs a program that was built into a shared library (load.c) in this environment, whose Python finds the libraries of ROS 2."""

import ctypes
import sys


def main() -> int:
    program = ctypes.CDLL(sys.argv[1], mode=ctypes.RTLD_GLOBAL)
    arguments = [argument.encode() for argument in sys.argv[1:]]
    argv = (ctypes.c_char_p * (len(arguments) + 1))(*arguments, None)
    return program.load_main(len(arguments), argv)


if __name__ == "__main__":
    sys.exit(main())
