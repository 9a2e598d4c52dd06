"""The steps for the methods of a user's drive class, such as `value = yield from read(register)`."""

from multidrop.drive.verbs import Script as Script
from multidrop.drive.verbs import insist as insist
from multidrop.drive.verbs import read as read
from multidrop.drive.verbs import until as until
from multidrop.drive.verbs import verb as verb
from multidrop.drive.verbs import wait as wait
from multidrop.drive.verbs import write as write

__all__ = ["Script", "insist", "read", "until", "verb", "wait", "write"]
