"""Parameters of a drive: read them all, compare them, and write those that differ."""

from multidrop.params.apply import Applied as Applied
from multidrop.params.apply import ApplyPlan as ApplyPlan
from multidrop.params.apply import NotWritten as NotWritten
from multidrop.params.apply import ParameterChange as ParameterChange
from multidrop.params.apply import apply as apply
from multidrop.params.apply import apply_plan as apply_plan
from multidrop.params.apply import plan as plan
from multidrop.params.files import is_parameter_file as is_parameter_file
from multidrop.params.files import load as load
from multidrop.params.files import save as save
from multidrop.params.files import to_csv as to_csv
from multidrop.params.files import to_toml as to_toml
from multidrop.params.values import Difference as Difference
from multidrop.params.values import ParameterSet as ParameterSet
from multidrop.params.values import compare as compare
from multidrop.params.values import defaults as defaults
from multidrop.params.values import read as read
from multidrop.params.values import rows as rows
