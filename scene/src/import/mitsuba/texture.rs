//! Textures.

use super::Converter;
use super::xml::{ObjectId, Property, malformed};
use crate::ImportError;
use crate::description::{Affine, Checkerboard, MeshAttribute, Place, TexelFilter, Texture, TextureKind, UvMap, Wrap};
use crate::image;

impl Converter<'_> {
    /// Number of the texture that a property holds or refers to; `None` when it is no texture of ours.
    ///
    /// A texture that is not supported, or whose file is missing or no image, is noted, and `Some(None)`.
    pub(super) fn texture_of(
        &mut self,
        property: &Property,
        stand_in: &str,
    ) -> Result<Option<Option<u32>>, ImportError> {
        let Some(id) = self.document.object(property)? else { return Ok(None) };
        let object = &self.document.objects[id];
        match (object.class.as_str(), object.plugin.as_str()) {
            ("texture", "bitmap" | "checkerboard" | "mesh_attribute") => {}
            _ => return Ok(None),
        }
        if let Some(&known) = self.textures.get(&id) {
            return Ok(Some(known));
        }
        self.enter(id, &property.place)?;
        let kind = match object.plugin.as_str() {
            "bitmap" => self.bitmap(id, stand_in)?,
            "mesh_attribute" => Some(self.attribute(id)?),
            _ => self.checkerboard(id)?,
        };
        self.leave(id);
        let number = kind.map(|kind| {
            // the same file, looked at the same way, is one texture
            let same = self.out.textures.iter().position(|t| t.kind == kind);
            same.unwrap_or_else(|| {
                self.out.textures.push(Texture { place: object.place.clone(), kind });
                self.out.textures.len() - 1
            }) as u32
        });
        self.textures.insert(id, number);
        Ok(Some(number))
    }

    fn bitmap(&mut self, id: ObjectId, stand_in: &str) -> Result<Option<TextureKind>, ImportError> {
        let place = &self.document.objects[id].place;
        // how Mitsuba keeps texels in memory, and 0.6 filtered them
        self.ignore(id, &["format", "accel", "cache", "max_anisotropy"]);
        let raw = match self.gamma(id)? {
            Some(linear) => linear,
            None => self.boolean(id, "raw")?.unwrap_or(false),
        };
        let filter = match self.string(id, "filter_type")? {
            // the two of 0.5 and 0.6 differ from bilinear where many texels fall on one pixel: there our samples do their work
            None | Some(("bilinear" | "trilinear" | "ewa", _)) => TexelFilter::Bilinear,
            Some(("nearest", _)) => TexelFilter::Nearest,
            Some((name, at)) => {
                self.unsupported(at, format!("filter_type \"{name}\""), "bilinear");
                TexelFilter::Bilinear
            }
        };
        let wrap = match self.string(id, "wrap_mode")? {
            None | Some(("repeat", _)) => Wrap::Repeat,
            Some(("mirror", _)) => Wrap::Mirror,
            Some(("clamp", _)) => Wrap::Clamp,
            Some((name, at)) => {
                self.unsupported(at, format!("wrap_mode \"{name}\""), "repeat");
                Wrap::Repeat
            }
        };
        let to_uv = self.uv_map(id)?;
        let Some((name, at)) = self.string(id, "filename")? else {
            return malformed(place, "a bitmap lacks its filename");
        };
        // a file that is missing or no image is one of many, perhaps: all are listed
        if !self.document.exists(name, at) {
            self.unsupported(at, format!("texture file \"{name}\" (there is no such file)"), stand_in);
            return Ok(None);
        }
        let path = self.document.resolve(name, at)?;
        if let Err(why) = image::header(&path, raw) {
            self.unsupported(at, format!("texture file \"{name}\" (it {why})"), stand_in);
            return Ok(None);
        }
        Ok(Some(TextureKind::Image { path, raw, wrap, filter, to_uv }))
    }

    /// 0.6: an exponent of 1 is linear, -1 is sRGB.
    fn gamma(&mut self, id: ObjectId) -> Result<Option<bool>, ImportError> {
        match self.float(id, "gamma")? {
            None => Ok(None),
            Some(1.0) => Ok(Some(true)),
            Some(-1.0) => Ok(Some(false)),
            Some(gamma) => {
                let place = &self.document.objects[id].place;
                self.unsupported(place, format!("gamma {gamma} of a bitmap"), "sRGB");
                Ok(Some(false))
            }
        }
    }

    fn checkerboard(&mut self, id: ObjectId) -> Result<Option<TextureKind>, ImportError> {
        // of a lamp they may be beyond 1
        let first = self.light(id, "color0")?.unwrap_or([0.4; 3]);
        let second = self.light(id, "color1")?.unwrap_or([0.2; 3]);
        Ok(Some(TextureKind::Checkerboard(Checkerboard { to_uv: self.uv_map(id)?, colors: [first, second] })))
    }

    /// Mitsuba 3's `mesh_attribute`.
    fn attribute(&mut self, id: ObjectId) -> Result<TextureKind, ImportError> {
        let place = &self.document.objects[id].place;
        let Some((name, at)) = self.string(id, "name")? else {
            return malformed(place, "a mesh_attribute lacks its name");
        };
        if attribute_of(name).is_none() {
            return malformed(at, format!("\"{name}\" should begin with vertex_ or face_, and go on"));
        }
        let scale = self.float(id, "scale")?.unwrap_or(1.0) as f32;
        if !scale.is_finite() {
            return malformed(place, "the scale of a mesh_attribute is too large");
        }
        Ok(TextureKind::Attribute { name: name.into(), scale })
    }

    /// What a shape's file must be read for: the attribute that its material or its emission names. There is room for one.
    pub(super) fn attribute_for(
        &mut self,
        plugin: &str,
        place: &Place,
        material: u32,
        emission: Option<u32>,
    ) -> Option<MeshAttribute> {
        let mut names: Vec<String> = vec![];
        let mut open = vec![material];
        let mut textures: Vec<u32> = vec![];
        while let Some(n) = open.pop() {
            let Some(detail) = &self.out.materials[n as usize].detail else { continue };
            open.extend(detail.materials());
            textures.extend(detail.textures());
        }
        for n in textures.into_iter().chain(emission) {
            if let TextureKind::Attribute { name, .. } = &self.out.textures[n as usize].kind
                && !names.contains(name)
            {
                names.push(name.clone());
            }
        }
        let first = names.first()?;
        let wanted = attribute_of(first);
        if plugin != "ply" {
            self.unsupported(
                place,
                format!("mesh attribute \"{first}\" of shape \"{plugin}\", which has none"),
                "black",
            );
            return None;
        }
        if let Some(other) = names.get(1) {
            let what = format!("mesh attribute \"{other}\" beside \"{first}\" on one shape");
            self.unsupported(place, what, "the first of them");
        }
        wanted
    }

    /// `to_uv`: x and y of a map in space. In 0.5 and 0.6 offsets and scales, which Mitsuba 3 reads as: first the offset, then the scale.
    fn uv_map(&self, id: ObjectId) -> Result<UvMap, ImportError> {
        let old = |name: &str| self.float(id, name);
        let offset = [old("uoffset")?, old("voffset")?];
        let scale = [old("uscale")?, old("vscale")?];
        let map = if offset.iter().chain(&scale).any(Option::is_some) {
            let [du, dv] = offset.map(|x| x.unwrap_or(0.0));
            let [su, sv] = scale.map(|x| x.unwrap_or(1.0));
            Affine([[su, 0.0, 0.0, su * du], [0.0, sv, 0.0, sv * dv], [0.0, 0.0, 1.0, 0.0]])
        } else {
            self.transform(id, "to_uv")?
        };
        let rows = [0, 1].map(|r| [map.0[r][0], map.0[r][1], map.0[r][3]].map(|x| x as f32));
        if rows.iter().flatten().any(|x| !x.is_finite()) {
            return malformed(&self.document.objects[id].place, "to_uv is too large for floating point");
        }
        Ok(UvMap(rows))
    }
}

/// The attribute that a name stands for.
fn attribute_of(name: &str) -> Option<MeshAttribute> {
    let of_faces = name.starts_with("face_");
    let rest = name.strip_prefix(if of_faces { "face_" } else { "vertex_" }).filter(|rest| !rest.is_empty())?;
    // whole numbers are not brought into [0, 1], as Mitsuba does not (it warns)
    Some(MeshAttribute { of_faces, name: rest.into(), srgb: false })
}
