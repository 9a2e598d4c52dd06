"""Computed channels: values that are computed from polled registers. No I/O and no clock."""

from multidrop.channels.channel_set import MOST_NAME as MOST_NAME
from multidrop.channels.channel_set import OLD as OLD
from multidrop.channels.channel_set import ChannelSet as ChannelSet
from multidrop.channels.channel_set import Outage as Outage
from multidrop.channels.channel_set import SlotRow as SlotRow
from multidrop.channels.grammar import MOST_CHARACTERS as MOST_CHARACTERS
from multidrop.channels.program import Channel as Channel
from multidrop.channels.program import DriveSeries as DriveSeries
