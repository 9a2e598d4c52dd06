"""Test runs: carry out the steps of a test file on a plant that is polled and recorded."""

from multidrop.runs.loader import load_test as load_test
from multidrop.runs.model import AbortLimits as AbortLimits
from multidrop.runs.model import ReadingCondition as ReadingCondition
from multidrop.runs.model import RunPlan as RunPlan
from multidrop.runs.model import RunStep as RunStep
from multidrop.runs.runner import RunResult as RunResult
from multidrop.runs.runner import TestRun as TestRun
