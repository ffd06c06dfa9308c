"""The contract of the network: what goes in, what comes out, and what a model file says about itself."""

from deepclouds.model.contract import (
    AUX,
    CONTRACT_VERSION,
    INPUT_AUX,
    INPUT_STENCIL,
    LEVELS,
    OUTPUT,
    POINTS,
    AuxInput,
    aux_inputs,
    multiple_scattering,
)
from deepclouds.model.metadata import DescriptorSpec, ModelMetadata, initialiser_hash
from deepclouds.model.trust import Trust

__all__ = [
    "AUX",
    "CONTRACT_VERSION",
    "INPUT_AUX",
    "INPUT_STENCIL",
    "LEVELS",
    "OUTPUT",
    "POINTS",
    "AuxInput",
    "DescriptorSpec",
    "ModelMetadata",
    "Trust",
    "aux_inputs",
    "initialiser_hash",
    "multiple_scattering",
]
