"""Array types of the equations, for one example and one seed; a name in a shape is the size of an axis."""

from __future__ import annotations

from typing import TypeAlias

from jaxtyping import Array, Float, Int, PRNGKeyArray

Scalar: TypeAlias = Float[Array, ""]
Scalars: TypeAlias = Float[Array, " n"]
Observation: TypeAlias = Float[Array, " observation"]
Observations: TypeAlias = Float[Array, "batch observation"]
Action: TypeAlias = Float[Array, " action"]
Actions: TypeAlias = Float[Array, "batch action"]
Count: TypeAlias = Int[Array, ""]
Key: TypeAlias = PRNGKeyArray
