"""What is to be flown: every scenario field, its unit in its name, its bounds and its default; a file a section.

The fields' descriptions are the reference (`sortie list schema` exports them as JSON Schema).
Frames: world is ENU (x east, y north, z up, metres), bodies are FLU (x forward, y left, z up).
"""

from sortie.scenarios.schema.base import DroneId, PhaseName, PointM, Section, Soc
from sortie.scenarios.schema.context import Context, DescriptorForm
from sortie.scenarios.schema.events import KINDS, AnyEvent
from sortie.scenarios.schema.events.base import Event, Jammer, Lasting, MemberEvent, PoseFault
from sortie.scenarios.schema.expect import DecisionExpectation, Expectation
from sortie.scenarios.schema.fleet import (
    Airframe,
    Battery,
    Clocks,
    Computer,
    DroneOverride,
    Fleet,
    Polarisation,
)
from sortie.scenarios.schema.limits import Limits
from sortie.scenarios.schema.mission import Mission, Phase, Region, Target
from sortie.scenarios.schema.movement import (
    FlightGroup,
    Formation,
    GroundStation,
    Leg,
    Motion,
    Origin,
    Route,
    Steering,
    Viewpoints,
)
from sortie.scenarios.schema.perception import Perception, Person, Scene, Thermal
from sortie.scenarios.schema.policy import PolicyChange, PolicyCommand, PolicySection, ViewReplay
from sortie.scenarios.schema.radio import MIN_TILE_BYTES, Bursts, Radio
from sortie.scenarios.schema.record import RecordSection
from sortie.scenarios.schema.scenario import Scenario, json_schema
