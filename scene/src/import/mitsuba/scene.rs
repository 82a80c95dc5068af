//! The root: its children in source order, and the integrator.

use super::Converter;
use rayherd_render::aov::{Aov, Aovs};

use super::xml::malformed;
use crate::ImportError;

/// Most rays of a path; what a frame takes.
const LARGEST_DEPTH: u32 = 65535;

/// Integrators that estimate the full light transport: the same image as path tracing.
const FULL_TRANSPORT: &[&str] = &[
    "path",
    "volpath",
    "volpathmis",
    "volpath_simple",
    "bdpt",
    "mlt",
    "pssmlt",
    "ppm",
    "sppm",
    "erpt",
    "ptracer",
    "prb",
    "prb_basic",
    "prb_projective",
    "prbvolpath",
    "path_guiding_integrator",
    "path_tracing_integrator_py",
    "guided_path",
];

/// What Mitsuba's `aov` integrator calls what we have.
const AOVS: &[(&str, Aov)] = &[
    ("albedo", Aov::Albedo),
    ("sh_normal", Aov::Normal),
    ("depth", Aov::Depth),
    ("position", Aov::Position),
    ("uv", Aov::Uv),
    ("shape_index", Aov::ObjectId),
];

impl Converter<'_> {
    pub(super) fn scene(&mut self) -> Result<(), ImportError> {
        let root = 0;
        for (_, id) in self.nested(root, "sensor")?.into_iter().take(1) {
            self.sensor(id)?;
        }
        for (_, id) in self.nested(root, "sensor")?.into_iter().skip(1) {
            let object = &self.document.objects[id];
            let name = object.id.as_deref().unwrap_or(&object.plugin);
            tracing::warn!("{}: sensor \"{name}\" is left out: the first of a scene's sensors is used", object.place);
        }
        for (n, (_, id)) in self.nested(root, "integrator")?.into_iter().enumerate() {
            if n > 0 {
                return malformed(&self.document.objects[id].place, "a second integrator: a scene has one");
            }
            self.integrator(id)?;
        }
        // materials first, so that their numbers follow the file whoever refers to them
        for (property, id) in self.nested(root, "bsdf")? {
            self.material(id, &property.place)?;
        }
        for (_, id) in self.nested(root, "emitter")? {
            self.scene_emitter(id)?;
        }
        for (property, id) in self.nested(root, "shape")? {
            self.shape(id, &property.place)?;
        }
        // named media, textures and the like matter only where they are used
        for class in ["texture", "medium", "phase", "volume", "spectrum"] {
            self.nested(root, class)?;
        }
        self.leave(root);
        Ok(())
    }

    fn integrator(&mut self, id: usize) -> Result<(), ImportError> {
        let object = &self.document.objects[id];
        let place = &object.place;
        if object.plugin == "aov" {
            return self.aov_integrator(id);
        }
        self.out.max_depth = match self.integer(id, "max_depth")? {
            None => None,
            Some(-1) => {
                let text = "max_depth -1 (unbounded): paths have as many rays as --max-depth says, 65 by default";
                self.note(place, text);
                None
            }
            Some(n) => match u32::try_from(n) {
                Ok(n) if n <= LARGEST_DEPTH => Some(n),
                _ => return malformed(place, format!("max_depth should be -1 (unbounded) or 0 to {LARGEST_DEPTH}")),
            },
        };
        self.out.rr_depth = match self.integer(id, "rr_depth")? {
            None => None,
            Some(n) => match u32::try_from(n) {
                Ok(n) if n > 0 => Some(n),
                _ => return malformed(place, "rr_depth should be at least 1"),
            },
        };
        match object.plugin.as_str() {
            "path" => {}
            plugin if FULL_TRANSPORT.contains(&plugin) => {
                tracing::info!(integrator = plugin, "rendered by path tracing, which estimates the same image");
                let names = object.properties.iter().map(|p| p.name.as_str()).filter(|name| *name != "hide_emitters");
                let names: Vec<&str> = names.collect();
                self.pass_over(id, &names, "path tracing estimates the same image without them");
            }
            "direct" => {
                if self.out.max_depth.is_some() || self.out.rr_depth.is_some() {
                    self.note(
                        place,
                        "integrator \"direct\" has paths of two rays, whatever max_depth and rr_depth say",
                    );
                }
                (self.out.max_depth, self.out.rr_depth) = (Some(2), None);
                let names = ["emitter_samples", "bsdf_samples", "shading_samples"];
                self.pass_over(
                    id,
                    &names,
                    "a sample of a pixel is one path, whose two kinds of sample are weighed against each other",
                );
            }
            plugin => {
                self.unsupported(place, format!("integrator \"{plugin}\""), "path tracing");
                if self.options.substitute {
                    object.properties.iter().for_each(|p| p.used.set(true));
                }
            }
        }
        if self.boolean(id, "strict_normals")? == Some(true) {
            self.note(place, "strict_normals changes nothing: light never leaks through bent normals here");
        }
        self.ignore(id, &["samples_per_pass", "block_size"]);
        self.pass_over(id, &["timeout"], "a render ends with its last sample");
        self.out.hide_emitters = self.boolean(id, "hide_emitters")?.unwrap_or(false);
        self.leave(id);
        Ok(())
    }

    /// AOVs around an integrator that says how the light is found.
    fn aov_integrator(&mut self, id: usize) -> Result<(), ImportError> {
        let place = self.document.objects[id].place.clone();
        let mut aovs = Vec::new();
        if let Some((text, place)) = self.string(id, "aovs")? {
            for item in text.split(',').map(str::trim).filter(|item| !item.is_empty()) {
                let Some((_, kind)) = item.split_once(':') else {
                    return malformed(place, format!("{item:?} should be NAME:KIND, such as dd.y:depth"));
                };
                match AOVS.iter().find(|(name, _)| *name == kind.trim()) {
                    Some(&(_, aov)) => aovs.push(aov),
                    None => self.unsupported(place, format!("AOV \"{}\"", super::shorten(kind.trim())), "nothing"),
                }
            }
        }
        let aovs: Aovs = aovs.into_iter().collect();
        self.out.aovs = Some(aovs);
        let text = format!("AOVs are layers of the EXR, and have names of their own: {aovs}");
        self.note(&place, text);
        let mut inner = self.nested(id, "integrator")?.into_iter();
        if let Some((property, nested)) = inner.next() {
            match self.document.objects[nested].plugin.as_str() {
                // also where it refers to itself
                "aov" => self.unsupported(&property.place, "integrator \"aov\" in integrator \"aov\"", "nothing"),
                _ => self.integrator(nested)?,
            }
        }
        for (property, _) in inner {
            self.unsupported(&property.place, "another integrator in integrator \"aov\"", "nothing");
        }
        self.leave(id);
        Ok(())
    }
}
