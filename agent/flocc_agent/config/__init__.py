"""The configuration of an agent, by noun; what other packages use stands here."""

from flocc_agent.config.agent_config import AgentConfig, CoreSection, KeyframeConfig, SourceConfig, StoreConfig
from flocc_agent.config.backend import BackendConfig, BackendMode, Formulation, ScaleInitial, Solver
from flocc_agent.config.emulated_radio import (
    BlackoutConfig,
    LinkConfig,
    LinkOverrideConfig,
    PartitionConfig,
    RadioConfig,
)
from flocc_agent.config.network import MetricsConfig, PeerEndpoints, TlsConfig, TransportConfig
from flocc_agent.config.perception import (
    ClassicalConfig,
    LearnedConfig,
    Mast3rConfig,
    PerceptionConfig,
    RecordedConfig,
    SyntheticConfig,
)
from flocc_agent.config.ros2 import Ros2Config
from flocc_agent.config.section import (
    ConfigError,
    Section,
    parsed_change,
    put_value,
    read_json,
    read_toml,
    refuse_removed,
    validated,
)

__all__ = [
    "AgentConfig",
    "BackendConfig",
    "BackendMode",
    "BlackoutConfig",
    "ClassicalConfig",
    "ConfigError",
    "CoreSection",
    "Formulation",
    "KeyframeConfig",
    "LearnedConfig",
    "LinkConfig",
    "LinkOverrideConfig",
    "Mast3rConfig",
    "MetricsConfig",
    "PartitionConfig",
    "PeerEndpoints",
    "PerceptionConfig",
    "RadioConfig",
    "RecordedConfig",
    "Ros2Config",
    "ScaleInitial",
    "Section",
    "Solver",
    "SourceConfig",
    "StoreConfig",
    "SyntheticConfig",
    "TlsConfig",
    "TransportConfig",
    "parsed_change",
    "put_value",
    "read_json",
    "read_toml",
    "refuse_removed",
    "validated",
]
