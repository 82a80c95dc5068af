//! Models as blocks of vertices take them: those whose lobe, if any, is isotropic; parameters by value, functions without
//! branches. They are the same inlined code as [`Bsdf::eval`] and [`Bsdf::sample`], so the bits are the same.

use super::detail::{Textured, scaled, share};
use super::dielectric::RoughInterface;
use super::plastic::Coated;
use super::rough::Rough;
use super::{Bsdf, Detail, Distribution, Material, Principled, Scatter, Slot, Transmittance, conductor, diffuse};
use crate::real::{Vec3, f32};
use crate::texture::{At, Spot, Texture, Textures};

/// What a block needs of a material at a hit.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Look {
    /// Lambertian, of this albedo.
    Diffuse([f32; 3]),
    /// A diffuse base under a rough coat.
    Coat(Coat),
    /// Rough metal.
    Metal(Metal),
    /// A rough interface of glass.
    Glass(Glass),
    /// The model of many parameters.
    Principled(Principled),
}

/// [`Bsdf::RoughPlastic`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct Coat {
    pub distribution: Distribution,
    pub alpha: f32,
    pub eta: f32,
    pub diffuse: [f32; 3],
    pub specular: [f32; 3],
    pub nonlinear: bool,
    /// Share of diffuse light from inside that is thrown back.
    pub internal: f32,
}

/// [`Bsdf::RoughConductor`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct Metal {
    pub distribution: Distribution,
    pub alpha: f32,
    pub eta: [f32; 3],
    pub k: [f32; 3],
    pub specular: [f32; 3],
}

/// What has to be computed for a vertex: those of one kind share a block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// [`Look::Diffuse`].
    Diffuse,
    /// [`Look::Coat`].
    Coat(Distribution),
    /// [`Look::Metal`].
    Metal(Distribution),
    /// [`Look::Glass`].
    Glass(Distribution),
    /// [`Look::Principled`]; whether light passes through.
    Principled { through: bool },
}

impl Kind {
    /// Every kind.
    pub(crate) const ALL: [Kind; 9] = [
        Kind::Diffuse,
        Kind::Coat(Distribution::Ggx),
        Kind::Coat(Distribution::Beckmann),
        Kind::Metal(Distribution::Ggx),
        Kind::Metal(Distribution::Beckmann),
        Kind::Glass(Distribution::Ggx),
        Kind::Glass(Distribution::Beckmann),
        Kind::Principled { through: false },
        Kind::Principled { through: true },
    ];

    /// Its place among all.
    #[inline(always)]
    pub(crate) fn number(self) -> usize {
        match self {
            Kind::Diffuse => 0,
            Kind::Coat(distribution) => 1 + usize::from(distribution == Distribution::Beckmann),
            Kind::Metal(distribution) => 3 + usize::from(distribution == Distribution::Beckmann),
            Kind::Glass(distribution) => 5 + usize::from(distribution == Distribution::Beckmann),
            Kind::Principled { through } => 7 + usize::from(through),
        }
    }

    /// Whether light passes through.
    #[inline(always)]
    pub(crate) fn transmits(self) -> bool {
        matches!(self, Kind::Glass(_) | Kind::Principled { through: true })
    }

    /// Whether it matters from which side the surface is seen.
    #[inline(always)]
    pub(crate) fn has_sides(self) -> bool {
        matches!(self, Kind::Glass(_) | Kind::Principled { .. })
    }
}

/// [`Bsdf::RoughDielectric`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct Glass {
    pub distribution: Distribution,
    pub alpha: f32,
    /// Index inside over outside; in a block that beyond the surface over that on this side.
    pub eta: f32,
    pub reflect: [f32; 3],
    pub transmit: [f32; 3],
}

impl Material {
    /// The kind of [`Material::look`], if that says something at every place.
    #[inline(always)]
    pub(crate) fn kind(&self) -> Option<Kind> {
        let kind = match &self.bsdf {
            Bsdf::Diffuse { .. } => Kind::Diffuse,
            Bsdf::RoughPlastic { distribution, .. } => Kind::Coat(*distribution),
            Bsdf::RoughConductor { distribution, alpha, .. } if alpha[0] == alpha[1] => Kind::Metal(*distribution),
            Bsdf::RoughDielectric { distribution, alpha, .. } if alpha[0] == alpha[1] => Kind::Glass(*distribution),
            Bsdf::Principled(p) if p.anisotropic == 0.0 => Kind::Principled { through: self.bsdf.transmits() },
            _ => return None,
        };
        // what makes a lobe anisotropic, or another kind of it
        let changes = |t: &Textured| match kind {
            Kind::Principled { .. } => matches!(t.slot, Slot::Anisotropic | Slot::Metallic | Slot::SpecTrans),
            _ => matches!(t.slot, Slot::AlphaU | Slot::AlphaV),
        };
        let is_paint = |detail: &Detail| detail.is_paint() && !detail.textured.iter().any(changes);
        self.detail.as_deref().is_none_or(is_paint).then_some(kind)
    }

    /// The model as a block takes it, textures aside; `None` where there is more to it.
    #[inline(always)]
    pub(crate) fn even_look(&self) -> Option<Look> {
        Some(match &self.bsdf {
            Bsdf::Diffuse { reflectance } => Look::Diffuse(*reflectance),
            Bsdf::RoughPlastic { distribution, alpha, eta, diffuse, specular, nonlinear, coat } => Look::Coat(Coat {
                distribution: *distribution,
                alpha: *alpha,
                eta: *eta,
                diffuse: *diffuse,
                specular: *specular,
                nonlinear: *nonlinear,
                internal: coat.internal,
            }),
            Bsdf::RoughConductor { distribution, alpha: [alpha, _], eta, k, specular } => {
                Look::Metal(Metal { distribution: *distribution, alpha: *alpha, eta: *eta, k: *k, specular: *specular })
            }
            Bsdf::RoughDielectric { distribution, alpha: [alpha, _], eta, reflect, transmit } => Look::Glass(Glass {
                distribution: *distribution,
                alpha: *alpha,
                eta: *eta,
                reflect: *reflect,
                transmit: *transmit,
            }),
            Bsdf::Principled(p) => Look::Principled(*p),
            _ => return None,
        })
    }

    /// The model at a place, of a material that has a [`Material::kind`]. `first`: what the first of its textures reads there.
    #[inline(always)]
    pub(crate) fn look(&self, textures: &[Texture], tiles: &dyn Textures, at: At, first: &Spot) -> Option<Look> {
        let mut look = self.even_look()?;
        let Some(detail) = &self.detail else { return Some(look) };
        for (k, &Textured { slot, texture, scale }) in detail.textured.iter().enumerate() {
            let texture = &textures[texture as usize];
            match (slot, &mut look) {
                (
                    Slot::Diffuse,
                    Look::Diffuse(color)
                    | Look::Coat(Coat { diffuse: color, .. })
                    | Look::Principled(Principled { base_color: color, .. }),
                )
                | (
                    Slot::Specular,
                    Look::Coat(Coat { specular: color, .. })
                    | Look::Metal(Metal { specular: color, .. })
                    | Look::Glass(Glass { reflect: color, .. }),
                )
                | (Slot::Transmit, Look::Glass(Glass { transmit: color, .. })) => {
                    let spot = if k == 0 { *first } else { texture.spot(at) };
                    *color = scaled(texture.color_at(tiles, at, &spot), scale);
                }
                (Slot::Alpha, Look::Metal(Metal { alpha, .. }) | Look::Glass(Glass { alpha, .. })) => {
                    *alpha = share(texture.amount(tiles, at) * scale[0]);
                }
                (slot, Look::Principled(p)) => {
                    if let Some(number) = p.number_mut(slot) {
                        *number = share(texture.amount(tiles, at) * scale[0]);
                    }
                }
                // of no meaning for this model, as in `Material::at`
                _ => {}
            }
        }
        Some(look)
    }

    /// The table of a rough coat.
    #[inline(always)]
    pub(crate) fn coat(&self) -> Option<&Transmittance> {
        match &self.bsdf {
            Bsdf::RoughPlastic { coat, .. } => Some(coat),
            _ => None,
        }
    }
}

impl Coat {
    /// Value and density where the shares `entering` and `leaving` pass at the cosines of `wo` and `wi`.
    #[inline(always)]
    pub(crate) fn eval(&self, entering: f32, leaving: f32, wo: Vec3, wi: Vec3) -> Scatter {
        self.coated().eval_between(&self.rough(), entering, leaving, self.internal, wo, wi)
    }

    /// A direction, and whether it is one.
    #[inline(always)]
    pub(crate) fn sample(&self, entering: f32, wo: Vec3, u: [f32; 2], lobe: f32) -> (Vec3, bool) {
        let (coat, of_coat) = self.rough().sample_or_not(wo, u);
        let (base, of_base) = diffuse::sample_or_not(u);
        let is_coat = lobe < self.coated().coat_probability(1.0 - entering);
        let pick = |a: f32, b: f32| if is_coat { a } else { b };
        let wi = Vec3::new(pick(coat.x, base.x), pick(coat.y, base.y), pick(coat.z, base.z));
        (wi, (wo.z > 0.0) & ((is_coat & of_coat) | (!is_coat & of_base)))
    }

    #[inline(always)]
    fn rough(&self) -> Rough {
        Rough::new(self.distribution, [self.alpha, self.alpha])
    }

    #[inline(always)]
    fn coated(&self) -> Coated {
        Coated {
            eta: self.eta,
            diffuse: Vec3::new(self.diffuse[0], self.diffuse[1], self.diffuse[2]),
            specular: Vec3::new(self.specular[0], self.specular[1], self.specular[2]),
            nonlinear: self.nonlinear,
        }
    }
}

impl Metal {
    /// Value and density.
    #[inline(always)]
    pub(crate) fn eval(&self, wo: Vec3, wi: Vec3) -> Scatter {
        let lobe = self.rough().lobe(wo, wi);
        lobe.reflecting(conductor::fresnel(lobe.cos, &self.eta, &self.k, &self.specular))
    }

    /// A direction, and whether it is one.
    #[inline(always)]
    pub(crate) fn sample(&self, wo: Vec3, u: [f32; 2]) -> (Vec3, bool) {
        self.rough().sample_or_not(wo, u)
    }

    #[inline(always)]
    fn rough(&self) -> Rough {
        Rough::new(self.distribution, [self.alpha, self.alpha])
    }
}

impl Glass {
    /// Value and density; `eta` is that beyond the surface over that on the side of `wo`.
    #[inline(always)]
    pub(crate) fn eval(&self, wo: Vec3, wi: Vec3) -> Scatter {
        self.interface().eval(wo, wi)
    }

    /// A direction, and whether it is one.
    #[inline(always)]
    pub(crate) fn sample(&self, wo: Vec3, u: [f32; 2], lobe: f32) -> (Vec3, bool) {
        self.interface().sample_or_not(wo, u, lobe)
    }

    #[inline(always)]
    fn interface(&self) -> RoughInterface {
        RoughInterface {
            rough: Rough::new(self.distribution, [self.alpha, self.alpha]),
            eta: self.eta,
            reflect: Vec3::new(self.reflect[0], self.reflect[1], self.reflect[2]),
            transmit: Vec3::new(self.transmit[0], self.transmit[1], self.transmit[2]),
        }
    }
}
