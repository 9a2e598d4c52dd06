"""Steps of a drive's own verbs: each is used as `value = yield from read(register)`."""

from multidrop.drive.script import Script as Script
from multidrop.drive.script import insist as insist
from multidrop.drive.script import read as read
from multidrop.drive.script import until as until
from multidrop.drive.script import wait as wait
from multidrop.drive.script import write as write
from multidrop.drive.verbs import verb as verb

__all__ = ["Script", "insist", "read", "until", "verb", "wait", "write"]
