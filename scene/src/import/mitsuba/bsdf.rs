//! Materials.

use super::xml::{ObjectId, Value, malformed};
use super::{Converter, luminance};
use crate::ImportError;
use crate::description::{
    Amount, Bsdf, Detail, Distribution, Material, Place, Relief, ReliefKind, Slot, TextureKind, Textured,
};
use crate::import::metals;

/// Mitsuba's stand-in where a shape names no material, and ours for unsupported ones.
const DEFAULT_REFLECTANCE: f32 = 0.5;
/// Largest eta and k of a metal: a thousand times what any has, and their fourth powers are numbers still.
const LARGEST_INDEX: f64 = 1e5;

/// What textures give of a model under construction.
pub(super) type Textures = Vec<Textured>;

impl Converter<'_> {
    /// Number of the material of an object; made once.
    pub(super) fn material(&mut self, id: ObjectId, from: &Place) -> Result<u32, ImportError> {
        if let Some(&n) = self.materials.get(&id) {
            return Ok(n);
        }
        let mut material = self.bsdf(id, from)?;
        material.name = self.document.objects[id].id.clone().unwrap_or_else(|| bsdf_name(&material).into());
        let n = self.push_material(material);
        self.materials.insert(id, n);
        Ok(n)
    }

    /// The material of a shape without one: grey, or black where the shape emits (Mitsuba's rule).
    pub(super) fn default_material(&mut self, emits: bool) -> u32 {
        let reflectance = if emits { [0.0; 3] } else { [DEFAULT_REFLECTANCE; 3] };
        let name = if emits { "default-emitter" } else { "default" };
        let material = Material::new(name, Bsdf::Diffuse { reflectance }, false);
        match self.out.materials.iter().position(|m| *m == material) {
            Some(n) => n as u32,
            None => self.push_material(material),
        }
    }

    pub(super) fn push_material(&mut self, material: Material) -> u32 {
        self.out.materials.push(material);
        self.out.materials.len() as u32 - 1
    }

    /// A material without a name.
    pub(super) fn bsdf(&mut self, id: ObjectId, from: &Place) -> Result<Material, ImportError> {
        self.enter(id, from)?;
        let object = &self.document.objects[id];
        let place = &object.place;
        let mut textured = Textures::new();
        let one_sided = |bsdf: Bsdf| Material::new("", bsdf, false);
        let mut out = match object.plugin.as_str() {
            "twosided" => self.two_sided(id)?,
            "mask" => self.mask(id)?,
            plugin @ ("bumpmap" | "normalmap") => self.relief(id, plugin)?,
            "diffuse" => {
                let reflectance = match self.paint(id, "reflectance", Slot::Diffuse, &mut textured)? {
                    Some(v) => v,
                    // the name in 0.5 and 0.6
                    None => self
                        .paint(id, "diffuse_reflectance", Slot::Diffuse, &mut textured)?
                        .unwrap_or([DEFAULT_REFLECTANCE; 3]),
                };
                one_sided(Bsdf::Diffuse { reflectance })
            }
            "conductor" => {
                let (eta, k) = self.index_of_refraction(id)?;
                let specular = self.paint(id, "specular_reflectance", Slot::Specular, &mut textured)?;
                one_sided(Bsdf::Conductor { eta, k, specular: specular.unwrap_or([1.0; 3]) })
            }
            "roughconductor" => {
                let (eta, k) = self.index_of_refraction(id)?;
                let specular = self.paint(id, "specular_reflectance", Slot::Specular, &mut textured)?;
                let distribution = self.distribution(id)?;
                let alpha = self.roughness(id, &mut textured)?;
                // how Mitsuba samples the lobe; the estimate is the same
                self.ignore(id, &["sample_visible"]);
                let specular = specular.unwrap_or([1.0; 3]);
                one_sided(Bsdf::RoughConductor { distribution, alpha, eta, k, specular })
            }
            plugin @ ("dielectric" | "thindielectric" | "roughdielectric") => {
                one_sided(self.transparent(id, plugin, &mut textured)?)
            }
            plugin @ ("plastic" | "roughplastic") => one_sided(self.plastic(id, plugin, &mut textured)?),
            "phong" => one_sided(self.phong(id, &mut textured)?),
            "principled" => one_sided(self.principled(id, &mut textured)?),
            "blendbsdf" => self.blend(id)?,
            // light passes as through a mask of opacity 0
            "null" => {
                let mut material = one_sided(Bsdf::Diffuse { reflectance: [0.0; 3] });
                detail_of(&mut material).opacity = Amount::Constant(0.0);
                material
            }
            plugin @ ("roughdiffuse" | "ward") => {
                self.unsupported(place, format!("bsdf \"{plugin}\""), "diffuse of its diffuse colour, two-sided");
                let mut reflectance = None;
                for name in ["diffuse_reflectance", "reflectance"] {
                    if reflectance.is_none() {
                        reflectance = self.paint(id, name, Slot::Diffuse, &mut textured)?;
                    }
                }
                object.properties.iter().for_each(|p| p.used.set(true));
                let reflectance = reflectance.unwrap_or([DEFAULT_REFLECTANCE; 3]);
                Material::new("", Bsdf::Diffuse { reflectance }, true)
            }
            plugin => {
                self.unsupported(place, format!("bsdf \"{plugin}\""), "grey diffuse, two-sided");
                object.properties.iter().for_each(|p| p.used.set(true));
                Material::new("", Bsdf::Diffuse { reflectance: [DEFAULT_REFLECTANCE; 3] }, true)
            }
        };
        self.leave(id);
        if !textured.is_empty() {
            detail_of(&mut out).textured = textured;
        }
        Ok(out)
    }

    fn two_sided(&mut self, id: ObjectId) -> Result<Material, ImportError> {
        let place = &self.document.objects[id].place;
        let inner = self.nested(id, "bsdf")?;
        let (mut front, back) = match inner[..] {
            [(p, inner)] => (self.bsdf(inner, &p.place)?, None),
            [(p, front), (q, back)] => (self.bsdf(front, &p.place)?, Some((back, q))),
            _ => return malformed(place, "twosided needs one or two materials inside"),
        };
        if self.lets_through(&front) {
            self.note(
                place,
                "twosided around a material that light passes: it has two sides of its own, twosided changes nothing",
            );
        }
        self.spread(&mut front, &mirror);
        if let Some((back, q)) = back {
            let mut behind = self.bsdf(back, &q.place)?;
            behind.name = self.document.objects[back].id.clone().unwrap_or_else(|| bsdf_name(&behind).into());
            self.spread(&mut behind, &mirror);
            let nests = |d: &Detail| d.back.is_some() || d.opacity != Amount::Constant(1.0);
            if self.has(&front, &nests) || self.has(&behind, &nests) {
                return malformed(place, "twosided with two materials takes no mask and no twosided inside");
            }
            let back = self.push_material(behind);
            detail_of(&mut front).back = Some(back);
        }
        Ok(front)
    }

    fn mask(&mut self, id: ObjectId) -> Result<Material, ImportError> {
        let place = &self.document.objects[id].place;
        let opacity = match self.property(id, "opacity") {
            None => Amount::Constant(0.5),
            Some(p) => match self.texture_of(p, "opacity 1")? {
                Some(number) => number.map_or(Amount::Constant(1.0), Amount::Texture),
                None => {
                    let [r, g, b] = self.color(id, "opacity", 1.0)?.unwrap_or([0.5; 3]);
                    let opacity = luminance([r, g, b]);
                    if !(0.0..=1.0).contains(&opacity) {
                        return malformed(&p.place, format!("opacity {opacity} should lie in [0, 1]"));
                    }
                    Amount::Constant(opacity as f32)
                }
            },
        };
        let mut inner = self.only_one_inside(id, "mask")?;
        if let Some(detail) = &inner.detail
            && detail.opacity != Amount::Constant(1.0)
        {
            self.unsupported(place, "mask around another mask", "the inner mask");
        } else if opacity != Amount::Constant(1.0) {
            detail_of(&mut inner).opacity = opacity;
        }
        Ok(inner)
    }

    fn relief(&mut self, id: ObjectId, plugin: &str) -> Result<Material, ImportError> {
        let object = &self.document.objects[id];
        let place = &object.place;
        let mut inner = self.only_one_inside(id, plugin)?;
        let kind = match plugin {
            "normalmap" => ReliefKind::Normals,
            _ => {
                let scale = self.float(id, "scale")?.unwrap_or(1.0) as f32;
                if !scale.is_finite() {
                    return malformed(place, "the scale of a bumpmap is too large");
                }
                ReliefKind::Bump(scale)
            }
        };
        // Mitsuba 3's; what 0.5 and 0.6 had no word for is shaded as it shades it
        let shadowed = self.boolean(id, "use_shadowing_function")?.unwrap_or(true);
        if self.boolean(id, "flip_invalid_normals")? == Some(false) {
            self.note(place, "flip_invalid_normals: a normal that the ray would see from behind is flipped, as by default, not black");
        }
        let mut found = None;
        for property in &object.properties {
            if let Some(map) = self.document.object(property)?
                && self.document.objects[map].class == "texture"
            {
                property.used.set(true);
                if found.replace(property).is_some() {
                    return malformed(&property.place, format!("a second texture in one {plugin}"));
                }
            }
        }
        let Some(property) = found else { return malformed(place, format!("{plugin} needs a texture inside")) };
        let texture = match self.texture_of(property, "no relief")? {
            Some(number) => number,
            None => {
                self.unsupported(&property.place, format!("this texture of {plugin}"), "no relief");
                None
            }
        };
        let Some(texture) = texture else { return Ok(inner) };
        if plugin == "bumpmap" && matches!(self.out.textures[texture as usize].kind, TextureKind::Attribute { .. }) {
            self.unsupported(&property.place, "mesh_attribute as a bumpmap", "no relief");
            return Ok(inner);
        }
        let relief = Relief { kind, texture, mirrored: false, shadowed };
        if self.has(&inner, &|d| d.relief.is_some()) {
            self.unsupported(place, format!("{plugin} around another relief"), "the inner relief");
            return Ok(inner);
        }
        self.spread(&mut inner, &|m| detail_of(m).relief = Some(relief));
        Ok(inner)
    }

    /// Changes a material, or what it is blended of, and what is on its back.
    fn spread(&mut self, material: &mut Material, change: &dyn Fn(&mut Material)) {
        let below: Vec<u32> = material.detail.iter().flat_map(|d| d.materials()).collect();
        if material.detail.as_ref().is_none_or(|d| d.blend.is_none()) {
            change(material);
        }
        for n in below {
            let mut part = self.out.materials[n as usize].clone();
            self.spread(&mut part, change);
            self.out.materials[n as usize] = part;
        }
    }

    /// Whether anything of a material is read from a texture.
    pub(super) fn is_textured(&self, material: u32) -> bool {
        let varies = |d: &Detail| {
            let is_texture = |a: &Amount| matches!(a, Amount::Texture(_));
            let weight = d.blend.as_ref().map(|b| &b.weight);
            !d.textured.is_empty() || d.relief.is_some() || is_texture(&d.opacity) || weight.is_some_and(is_texture)
        };
        self.has(&self.out.materials[material as usize], &varies)
    }

    /// Whether a material, or what it is made of, has a detail of a kind.
    fn has(&self, material: &Material, kind: &dyn Fn(&Detail) -> bool) -> bool {
        material.detail.as_ref().is_some_and(|detail| {
            kind(detail) || detail.materials().any(|n| self.has(&self.out.materials[n as usize], kind))
        })
    }

    /// Whether light passes a material, or something that it is blended of.
    fn lets_through(&self, material: &Material) -> bool {
        let blend = material.detail.as_ref().and_then(|d| d.blend.as_ref());
        match blend {
            Some(blend) => blend.parts.iter().any(|n| self.lets_through(&self.out.materials[*n as usize])),
            None => material.bsdf.transmits(),
        }
    }

    /// The one material inside an adapter.
    fn only_one_inside(&mut self, id: ObjectId, plugin: &str) -> Result<Material, ImportError> {
        match self.nested(id, "bsdf")?[..] {
            [(p, inner)] => self.bsdf(inner, &p.place),
            _ => malformed(&self.document.objects[id].place, format!("{plugin} needs one material inside")),
        }
    }

    /// A colour in [0, 1], or a texture for a slot.
    pub(super) fn paint(
        &mut self,
        id: ObjectId,
        name: &str,
        slot: Slot,
        textured: &mut Textures,
    ) -> Result<Option<[f32; 3]>, ImportError> {
        if let Some(p) = self.property(id, name)
            && let Some(number) = self.texture_of(p, "the grey 0.5")?
        {
            textured.extend(number.map(|texture| Textured::new(slot, texture)));
            return Ok(Some([DEFAULT_REFLECTANCE; 3]));
        }
        self.albedo(id, name)
    }

    /// Where a property stands, or the object where it has none of the name.
    pub(super) fn place_of(&self, id: ObjectId, name: &str) -> &Place {
        self.property(id, name).map_or(&self.document.objects[id].place, |p| &p.place)
    }

    /// A colour in [0, 1].
    pub(super) fn albedo(&mut self, id: ObjectId, name: &str) -> Result<Option<[f32; 3]>, ImportError> {
        let Some(rgb) = self.color(id, name, DEFAULT_REFLECTANCE.into())? else { return Ok(None) };
        if rgb.iter().any(|v| !(0.0..=1.0).contains(v)) {
            return malformed(self.place_of(id, name), format!("{name} {rgb:?} should lie in [0, 1]"));
        }
        Ok(Some(rgb.map(|v| v as f32)))
    }

    /// `eta` and `k`, by name or by value; relative to `ext_eta` where that is given.
    fn index_of_refraction(&mut self, id: ObjectId) -> Result<([f32; 3], [f32; 3]), ImportError> {
        let place = &self.document.objects[id].place;
        let eta = self.color(id, "eta", 0.2)?;
        let k = self.color(id, "k", 3.0)?;
        let material = self.string(id, "material")?;
        let by_value = eta.is_some() || k.is_some();
        let named = match material {
            Some((name, at)) if by_value && name != "none" && !self.document.old => {
                return malformed(at, "material beside eta or k: give one or the other");
            }
            // 0.5 and 0.6 have the values win over the name
            Some((name, at)) if eta.is_some() && k.is_some() && name != "none" => {
                self.note(at, format!("material \"{name}\" is passed over: eta and k are given"));
                None
            }
            Some((name, at)) if name != "none" => Some(match metals::find(name) {
                Some(metal) => (metal.eta.map(f64::from), metal.k.map(f64::from)),
                None => {
                    self.unsupported(at, format!("material \"{name}\""), "copper");
                    metals::find("Cu").map_or(([0.0; 3], [1.0; 3]), |m| (m.eta.map(f64::from), m.k.map(f64::from)))
                }
            }),
            _ => None,
        };
        if self.document.old && material.is_none() && (eta.is_none() || k.is_none()) {
            let plugin = &self.document.objects[id].plugin;
            self.note(
                place,
                format!(
                    "{plugin} without a material is a perfect mirror, as Mitsuba 3 reads it; 0.5 and 0.6 made it of copper: write material \
                     \"Cu\" for that, or \"none\" for the mirror"
                ),
            );
        }
        // Mitsuba 3's default: a perfect mirror
        let (eta_of, k_of) = named.unwrap_or(([0.0; 3], [1.0; 3]));
        let (eta, k) = (eta.unwrap_or(eta_of), k.unwrap_or(k_of));
        if !eta.iter().chain(&k).all(|v| (0.0..=LARGEST_INDEX).contains(v)) {
            return malformed(place, format!("eta and k should lie between 0 and {LARGEST_INDEX}"));
        }
        let outside = match self.property(id, "ext_eta").map(|p| (&p.value, &p.place)) {
            None => 1.0,
            Some((Value::Float(v), _)) if *v > 0.0 => *v,
            Some((Value::String(name), _)) if name == "air" => 1.000277,
            Some((Value::String(name), _)) if name == "vacuum" => 1.0,
            Some((_, at)) => {
                self.unsupported(at, "this ext_eta", "1");
                1.0
            }
        };
        Ok((eta.map(|v| (v / outside) as f32), k.map(|v| (v / outside) as f32)))
    }

    pub(super) fn distribution(&mut self, id: ObjectId) -> Result<Distribution, ImportError> {
        match self.string(id, "distribution")? {
            None => Ok(Distribution::Beckmann),
            Some((name, at)) => match name.to_ascii_lowercase().as_str() {
                "beckmann" => Ok(Distribution::Beckmann),
                "ggx" => Ok(Distribution::Ggx),
                _ => {
                    self.unsupported(at, format!("distribution \"{name}\""), "ggx");
                    Ok(Distribution::Ggx)
                }
            },
        }
    }

    /// Roughness along u and v; what textures give of it goes to `textured`.
    pub(super) fn roughness(&mut self, id: ObjectId, textured: &mut Textures) -> Result<[f32; 2], ImportError> {
        let place = &self.document.objects[id].place;
        let mut get = |name: &str, slot| -> Result<Option<f64>, ImportError> {
            if let Some(p) = self.property(id, name)
                && let Some(number) = self.texture_of(p, "0.1")?
            {
                textured.extend(number.map(|texture| Textured::new(slot, texture)));
                return Ok(Some(0.1));
            }
            Ok(self.color(id, name, 0.1)?.map(luminance))
        };
        let given = (get("alpha", Slot::Alpha)?, get("alpha_u", Slot::AlphaU)?, get("alpha_v", Slot::AlphaV)?);
        let alpha = match given {
            (alpha, None, None) => [alpha.unwrap_or(0.1); 2],
            (None, Some(u), Some(v)) => [u, v],
            _ => return malformed(place, "give alpha, or both alpha_u and alpha_v"),
        };
        if let Some(wrong) = alpha.iter().position(|a| !(*a > 0.0 && *a <= 1.0)) {
            let name = if given.1.is_none() { "alpha" } else { ["alpha_u", "alpha_v"][wrong] };
            return malformed(
                self.place_of(id, name),
                format!("roughness {alpha:?} should lie in (0, 1]; use conductor for a mirror"),
            );
        }
        Ok(alpha.map(|a| a as f32))
    }
}

/// The detail of a material, which gets one.
pub(super) fn detail_of(material: &mut Material) -> &mut Detail {
    material.detail.get_or_insert_default()
}

/// Inside of `twosided` the back is as the front, its relief too.
fn mirror(material: &mut Material) {
    material.two_sided = true;
    if let Some(relief) = material.detail.as_mut().and_then(|d| d.relief.as_mut()) {
        relief.mirrored = true;
    }
}

pub(super) fn bsdf_name(material: &Material) -> &'static str {
    if material.detail.as_ref().is_some_and(|d| d.blend.is_some()) {
        return "blendbsdf";
    }
    match material.bsdf {
        Bsdf::Diffuse { .. } => "diffuse",
        Bsdf::Conductor { .. } => "conductor",
        Bsdf::RoughConductor { .. } => "roughconductor",
        Bsdf::Dielectric { .. } => "dielectric",
        Bsdf::ThinDielectric { .. } => "thindielectric",
        Bsdf::RoughDielectric { .. } => "roughdielectric",
        Bsdf::Plastic { .. } => "plastic",
        Bsdf::RoughPlastic { .. } => "roughplastic",
        Bsdf::Phong { .. } => "phong",
        Bsdf::Principled(_) => "principled",
    }
}
