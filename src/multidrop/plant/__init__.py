"""The plant file."""

from multidrop.plant.drive_names import RESERVED_NAMES as RESERVED_NAMES
from multidrop.plant.drive_names import check_drive_name as check_drive_name
from multidrop.plant.drive_names import drive_meant as drive_meant
from multidrop.plant.model import MAY_KEYS as MAY_KEYS
from multidrop.plant.model import allowed as allowed
from multidrop.plant.model import current_for as current_for
