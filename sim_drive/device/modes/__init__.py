"""The modes of operation of the emulated drive, each an object that knows no other."""
