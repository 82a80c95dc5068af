//! Shapes: mesh files, rectangle, cube, disk, cylinder, sphere; groups and their instances.

use super::Converter;
use super::xml::{ObjectId, malformed};
use crate::ImportError;
use crate::description::{Affine, Geometry, MeshFormat, Place, Shape};
use crate::import::passed_over::passed_over;
use crate::import::shapes;
use crate::import::vector::{cross, dot};

/// Most shapes of a scene, those of instances counted one by one.
const MAX_SHAPES: usize = 1 << 20;

impl Converter<'_> {
    /// A shape of the scene. What a `shapegroup` holds is where its instances put it.
    pub(super) fn shape(&mut self, id: ObjectId, from: &Place) -> Result<(), ImportError> {
        self.shape_under(id, from, &Affine::IDENTITY)
    }

    /// A shape under the map of the instance that it belongs to.
    fn shape_under(&mut self, id: ObjectId, from: &Place, outer: &Affine) -> Result<(), ImportError> {
        let object = &self.document.objects[id];
        match object.plugin.as_str() {
            "instance" => return self.instance(id, from, outer),
            "shapegroup" => {
                // its shapes are read where an instance puts them
                self.nested(id, "shape")?;
                self.report_unused(id);
                return Ok(());
            }
            _ => {}
        }
        self.enter(id, from)?;
        let place = &object.place;
        let mut to_world = outer.after(&self.transform(id, "to_world")?);
        if self.out.shapes.len() >= MAX_SHAPES {
            let message = format!(
                "more than {MAX_SHAPES} shapes, instances counted one by one: join what stands together into one mesh"
            );
            return Err(ImportError::Limit { place: place.clone(), message });
        }
        if !to_world.determinant().is_finite() {
            return malformed(place, "to_world is too large for floating point");
        }
        if to_world.determinant() == 0.0 && !keeps_area(&object.plugin, &to_world) {
            let text =
                format!("to_world flattens this shape \"{}\": what of it has no area is left out", object.plugin);
            self.note(place, text);
        }
        let turned = is_turned(&to_world);
        let mut flip = self.boolean(id, "flip_normals")?.unwrap_or(false);
        let mut face_normals = self.boolean(id, "face_normals")?.unwrap_or(false);
        let mut geometry = match object.plugin.as_str() {
            "rectangle" => Some(shapes::rectangle()),
            "cube" => Some(shapes::cube()),
            "disk" => Some(shapes::disk()),
            "cylinder" => {
                to_world = self.cylinder(id, &to_world)?;
                Some(shapes::cylinder())
            }
            "serialized" => {
                let index = self.integer(id, "shape_index")?.unwrap_or(0);
                let Ok(index) = u32::try_from(index) else {
                    return malformed(place, format!("shape_index {index} should be at least 0"));
                };
                self.mesh(id, MeshFormat::Serialized(index), false)?
            }
            "sphere" => Some(self.sphere(id, &mut to_world, &mut flip)?),
            "ply" => self.mesh(id, MeshFormat::Ply, false)?,
            "obj" => self.mesh(id, MeshFormat::Obj, true)?,
            "stl" => {
                face_normals = true;
                self.mesh(id, MeshFormat::Stl, false)?
            }
            plugin => {
                self.unsupported(place, format!("shape \"{plugin}\""), "nothing");
                object.properties.iter().for_each(|p| p.used.set(true));
                None
            }
        };
        let emitters = self.nested(id, "emitter")?;
        if emitters.len() > 1 {
            return malformed(&emitters[1].0.place, "a second emitter in one shape");
        }
        let (mut emission, mut emission_texture) = (None, None);
        for (_, emitter) in emitters {
            let (radiance, texture) = self.area_emitter(emitter)?;
            emission = Some(radiance).filter(|rgb| rgb.iter().any(|v| *v > 0.0));
            emission_texture = texture;
        }
        let bsdfs = self.nested(id, "bsdf")?;
        if bsdfs.len() > 1 {
            return malformed(&bsdfs[1].0.place, "a second bsdf in one shape");
        }
        let material = match bsdfs.first() {
            Some((p, bsdf)) => self.material(*bsdf, &p.place)?,
            None => self.default_material(emission.is_some()),
        };
        if let Some(Geometry::MeshFile { path, format, .. }) = &geometry {
            let head = passed_over(path, *format);
            self.out.bytes_read += head.bytes_read;
            if head.libraries && bsdfs.is_empty() {
                self.note(place, "this obj names materials of its own (mtllib), which are not read in an XML scene: it is grey; put a bsdf into the shape");
            }
            if head.libraries && !bsdfs.is_empty() && self.document.old {
                self.note(place, "this obj names materials of its own (mtllib), which 0.5 and 0.6 gave to its parts: here the shape's bsdf counts, as in Mitsuba 3");
            }
            if bsdfs.is_empty() {
                head.looks.iter().for_each(|text| self.note(place, *text));
            }
        }
        self.ignore(id, &["silhouette_sampling_weight"]);
        self.leave(id);
        let textured = || emission_texture.is_some() || self.is_textured(material);
        if turned && matches!(geometry, Some(Geometry::Sphere { .. })) && textured() {
            self.unsupported(place, "a turned sphere with a texture", "the texture as on a sphere that is not turned");
        }
        let wanted = self.attribute_for(&object.plugin, place, material, emission_texture);
        if let Some(Geometry::MeshFile { attribute, .. }) = &mut geometry {
            *attribute = wanted;
        }
        let Some(geometry) = geometry else { return Ok(()) };
        let name = match (&object.id, &geometry) {
            (Some(id), _) => id.clone(),
            (None, Geometry::MeshFile { path, .. }) => {
                path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
            }
            (None, _) => object.plugin.clone(),
        };
        self.out.shapes.push(Shape {
            name,
            place: place.clone(),
            geometry,
            to_world,
            material,
            emission,
            emission_texture,
            flip_normals: flip,
            face_normals,
        });
        Ok(())
    }

    /// The shapes of a group under a map. Mitsuba keeps one copy of a group for all its instances; here each is laid out.
    fn instance(&mut self, id: ObjectId, from: &Place, outer: &Affine) -> Result<(), ImportError> {
        self.enter(id, from)?;
        let place = &self.document.objects[id].place;
        let to_world = outer.after(&self.transform(id, "to_world")?);
        let groups = self.nested(id, "shape")?;
        let [(at, group)] = groups[..] else {
            return malformed(place, "an instance needs one shapegroup inside, or a ref to one");
        };
        if self.document.objects[group].plugin != "shapegroup" {
            return malformed(&at.place, "what an instance refers to should be a shapegroup");
        }
        self.enter(group, &at.place)?;
        for (p, shape) in self.nested(group, "shape")? {
            self.shape_under(shape, &p.place, &to_world)?;
        }
        self.leave(group);
        self.leave(id);
        Ok(())
    }

    /// The map from the cylinder of radius 1 and height 1 to the one that an object describes.
    fn cylinder(&mut self, id: ObjectId, to_world: &Affine) -> Result<Affine, ImportError> {
        let place = &self.document.objects[id].place;
        let p0 = self.point(id, "p0")?.unwrap_or([0.0; 3]);
        let p1 = self.point(id, "p1")?.unwrap_or([0.0, 0.0, 1.0]);
        let radius = self.float(id, "radius")?.unwrap_or(1.0);
        match shapes::between(p0, p1, radius) {
            Some(map) => Ok(to_world.after(&map)),
            None => malformed(place, "a cylinder needs two different points and a radius above 0"),
        }
    }

    fn mesh(&mut self, id: ObjectId, format: MeshFormat, flip_v: bool) -> Result<Option<Geometry>, ImportError> {
        let object = &self.document.objects[id];
        let Some((name, place)) = self.string(id, "filename")? else {
            return malformed(&object.place, format!("shape \"{}\" lacks its filename", object.plugin));
        };
        // one of many, perhaps: all are listed
        if !self.document.exists(name, place) {
            self.unsupported(place, format!("mesh file \"{name}\" (there is no such file)"), "nothing");
            object.properties.iter().for_each(|p| p.used.set(true));
            return Ok(None);
        }
        let path = self.document.resolve(name, place)?;
        let flip_v = self.boolean(id, "flip_tex_coords")?.unwrap_or(flip_v);
        // 0.6: normals above this crease angle are split; without it its default is to use what the file has
        for name in ["max_smooth_angle", "shape_index"] {
            if matches!(format, MeshFormat::Serialized(_)) && name == "shape_index" {
                continue;
            }
            if let Some(p) = self.property(id, name) {
                self.unsupported(&p.place, format!("property \"{name}\" of shape \"{}\"", object.plugin), "nothing");
            }
        }
        Ok(Some(Geometry::MeshFile { path, format, flip_v, smooth: true, attribute: None, parts: None }))
    }

    /// Mitsuba's sphere: `to_world * translate(center) * scale(radius)`; a mirroring map turns it inside out.
    fn sphere(&mut self, id: ObjectId, to_world: &mut Affine, flip: &mut bool) -> Result<Geometry, ImportError> {
        let place = &self.document.objects[id].place;
        let center = self.point(id, "center")?.unwrap_or([0.0; 3]);
        let radius = self.float(id, "radius")?.unwrap_or(1.0);
        let columns = [0, 1, 2].map(|c| [0, 1, 2].map(|r| to_world.0[r][c]));
        let lengths = columns.map(|c| dot(c, c).sqrt());
        if radius == 0.0 || lengths.contains(&0.0) {
            return malformed(place, "a sphere of radius 0");
        }
        if !is_similarity(to_world) {
            let stand_in = "the sphere whose radius is that along x";
            self.unsupported(place, "sphere under a map that is no similarity (an ellipsoid)", stand_in);
        }
        if (to_world.determinant() < 0.0) != (radius < 0.0) {
            *flip = !*flip;
        }
        let center = to_world.point(center);
        let radius = radius.abs() * lengths[0];
        *to_world = Affine::IDENTITY;
        Ok(Geometry::Sphere { center, radius })
    }
}

/// Whether a singular map leaves a flat shape of x and y its area.
fn keeps_area(plugin: &str, map: &Affine) -> bool {
    let column = |c: usize| [0, 1, 2].map(|r| map.0[r][c]);
    matches!(plugin, "rectangle" | "disk") && cross(column(0), column(1)) != [0.0; 3]
}

/// Whether a map turns what it moves: off its diagonal, or on it below 0, by more than files round (1e-6 of the longest).
fn is_turned(map: &Affine) -> bool {
    let entries = (0..3).flat_map(|r| (0..3).map(move |c| (r, c, map.0[r][c])));
    let longest = entries.clone().map(|(.., x)| x.abs()).fold(0.0, f64::max);
    entries.into_iter().any(|(r, c, x)| if r == c { x < 0.0 } else { x.abs() > 1e-6 * longest })
}

/// Whether the columns are at right angles and equally long, to the precision that files write (1e-4 relative), and not 0.
pub(super) fn is_similarity(map: &Affine) -> bool {
    let columns = [0, 1, 2].map(|c| [0, 1, 2].map(|r| map.0[r][c]));
    let square = dot(columns[0], columns[0]);
    let within = 1e-4 * square;
    square > 0.0
        && (0..3).all(|i| {
            let j = (i + 1) % 3;
            dot(columns[i], columns[j]).abs() <= within && (dot(columns[i], columns[i]) - square).abs() <= within
        })
}
