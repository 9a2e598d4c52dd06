"""Find the drives on a serial line with unknown settings. Only reads are sent."""

from multidrop.scan.findings import Crowd as Crowd
from multidrop.scan.findings import Finding as Finding
from multidrop.scan.findings import Found as Found
from multidrop.scan.findings import Noise as Noise
from multidrop.scan.findings import Progress as Progress
from multidrop.scan.findings import Untried as Untried
from multidrop.scan.findings import line_setting as line_setting
from multidrop.scan.findings import plant_text as plant_text
from multidrop.scan.scanner import scan as scan
from multidrop.scan.sweep import ADDRESSES as ADDRESSES
from multidrop.scan.sweep import ScanRequest as ScanRequest
from multidrop.scan.sweep import Sweep as Sweep
from multidrop.scan.sweep import one_of_each_framing as one_of_each_framing
from multidrop.scan.sweep import over_tcp as over_tcp
from multidrop.scan.sweep import sweeps as sweeps
