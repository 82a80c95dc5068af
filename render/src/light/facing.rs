//! Which way a surface faces that light is sampled for.

use crate::real::{Vec3, f32};

/// Least cosine between a surface's normal and the way to a light that the choice reckons with: what seems to lie behind the surface is taken now
/// and then, since bounds are rough and a sample costs little where nothing comes of it.
const LEAST: f32 = 1.0 / 64.0;

/// The side of a surface that is lit.
///
/// What is chosen by it need not be known where a BSDF's ray meets the light, where the normal is forgotten: the weights of MIS are made of densities that know of
/// the point alone ([`super::LightSample::pdf`]), on both sides the same, so they sum to 1; and a sample is divided by the density with which it really came, which is
/// those times [`super::LightSample`]'s share of it. Both are right whatever the two densities are, as long as each is above 0 where light may come from
/// (Veach 1997, section 9.2: weights are any functions that sum to 1).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Facing {
    /// Unit, or 0.
    pub normal: Vec3,
    /// Of what is reckoned by cosines with the normal.
    pub least: f32,
}

impl Facing {
    /// Lit from all around.
    pub(crate) const ANY: Facing = Facing { normal: Vec3::ZERO, least: 1.0 };

    /// Lit on the side of a unit normal.
    #[inline(always)]
    pub(crate) fn front(normal: Vec3) -> Facing {
        Facing { normal, least: LEAST }
    }

    /// Whether nothing depends on it.
    #[inline(always)]
    pub(crate) fn is_any(&self) -> bool {
        self.least == 1.0
    }
}
