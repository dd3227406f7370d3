"""The sub-commands of `hiernav`, a file each. One imports what it needs when it runs."""
