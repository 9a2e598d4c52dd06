"""The plant file, which describes the lines and drives of a plant."""

from multidrop.drive.known_state import FAULT as FAULT
from multidrop.plant.loader import check_channels as check_channels
from multidrop.plant.model import FLEET_KEYS as FLEET_KEYS
from multidrop.plant.model import MAY_KEYS as MAY_KEYS
from multidrop.plant.model import RESERVED_NAMES as RESERVED_NAMES
from multidrop.plant.model import allowed as allowed
from multidrop.plant.model import check_drive_name as check_drive_name
from multidrop.plant.model import current_for as current_for
from multidrop.plant.model import drive_meant as drive_meant
from multidrop.plant.model import series_of as series_of
from multidrop.plant.triggers import POST_S as POST_S
from multidrop.plant.triggers import PRE_S as PRE_S
from multidrop.plant.triggers import TriggerSeries as TriggerSeries
from multidrop.plant.triggers import with_triggers as with_triggers
