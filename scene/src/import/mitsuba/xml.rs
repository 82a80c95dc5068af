//! From XML text to a tree of objects with typed properties: defaults, `$names`, includes and ids are dealt with here.
//!
//! All dialects (0.5, 0.6, 2, 3) are read by one grammar: property names are brought to snake case, so `toWorld` is `to_world`.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};

use super::text::{Lines, after_prolog, crowded_element, snake_case};
use super::{transform, value};
use crate::ImportError;
use crate::description::{Affine, Place};
use crate::import::{inside, regular};

/// Most bytes of XML read for one scene, includes among them.
const MAX_BYTES: u64 = 64 << 20;
/// Most nodes in one XML file: bounds the parser's memory to some 400 MB.
const MAX_NODES: u32 = 4 << 20;
/// Most bytes of values that `$names` put into one scene's attributes, all together. Defaults may name other defaults, so that a few lines
/// double their text with each ([billion laughs](https://en.wikipedia.org/wiki/Billion_laughs_attack)), and every value stays in
/// memory. As much as a scene may have of XML at all: no scene's parameters come near it.
const MAX_EXPANDED: usize = MAX_BYTES as usize;
/// Most bytes of one value.
const MAX_VALUE: usize = 1 << 20;
/// Deepest nesting of objects; ours is a recursive descent.
const MAX_DEPTH: usize = 64;
/// Most attributes of one element: the parser compares each with each.
const MAX_ATTRIBUTES: usize = 10_000;
/// Most include elements followed in one scene.
const MAX_INCLUDES: usize = 1024;

/// Number of an object in [`Document::objects`].
pub(super) type ObjectId = usize;

/// What a property holds.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Value {
    Float(f64),
    Integer(i64),
    Boolean(bool),
    String(String),
    Vector([f64; 3]),
    /// Linear RGB.
    Color([f64; 3]),
    /// A spectrum that RGB does not hold, as written.
    Spectrum(String),
    Transform(Affine),
    /// A nested object.
    Object(ObjectId),
    /// An object by its id.
    Reference(String),
}

/// One property of an object.
#[derive(Debug)]
pub(super) struct Property {
    /// In snake case; empty for nested objects and references without a name.
    pub name: String,
    pub value: Value,
    pub place: Place,
    /// Whether the conversion asked for it; what nobody asked for is unsupported.
    pub used: Cell<bool>,
}

/// An element with a `type`: shape, bsdf, sensor, ...
#[derive(Debug)]
pub(super) struct Object {
    /// Element name: `shape`, `bsdf`, ...
    pub class: String,
    /// Its `type`: `rectangle`, `diffuse`, ...
    pub plugin: String,
    pub id: Option<String>,
    pub place: Place,
    pub properties: Vec<Property>,
}

/// Everything in a scene file and what it includes.
#[derive(Debug)]
pub(super) struct Document {
    /// The root is number 0.
    pub objects: Vec<Object>,
    ids: BTreeMap<String, ObjectId>,
    /// Elements that no grammar of ours knows, for the list of what is unsupported.
    pub unknown: Vec<(Place, String)>,
    /// The canonical folder of the scene: no file outside is read.
    pub folder: PathBuf,
    /// Folders inside of it in which files are looked for first (`<path>`), the last named foremost, as in Mitsuba.
    paths: Vec<PathBuf>,
    /// Whether its version is below 2 (0.5 or 0.6), where some things mean something else.
    pub old: bool,
    /// Bytes of XML read.
    pub bytes_read: u64,
}

impl Document {
    /// Reads a file and what it includes. `defines` win over the file's defaults.
    pub fn read(path: &Path, defines: &[(String, String)]) -> Result<Document, ImportError> {
        let io = |source| ImportError::Io { path: path.into(), source };
        let canonical = path.canonicalize().map_err(io)?;
        let folder = inside::folder_of(path)?;
        let mut parameters = Parameters::new(defines);
        let mut reader = Reader {
            document: Document {
                objects: vec![],
                ids: BTreeMap::new(),
                unknown: vec![],
                folder,
                paths: vec![],
                old: false,
                bytes_read: 0,
            },
            including: vec![],
            includes: 0,
        };
        reader.file(path, &canonical, None, &mut parameters)?;
        if let Some(name) = parameters.unused_define() {
            let place = Place::file(path);
            let message =
                format!("-D {name}: the scene has no parameter ${name}; the names it has are {}", parameters.names());
            return Err(ImportError::Malformed { place, message });
        }
        Ok(reader.document)
    }

    /// The object that a property holds or refers to.
    pub fn object(&self, property: &Property) -> Result<Option<ObjectId>, ImportError> {
        match &property.value {
            Value::Object(id) => Ok(Some(*id)),
            Value::Reference(name) => match self.ids.get(name) {
                Some(id) => Ok(Some(*id)),
                None => malformed(&property.place, format!("ref to \"{name}\": nothing in the scene has this id")),
            },
            _ => Ok(None),
        }
    }

    /// Where a file that the scene names may be: in a `<path>`, or relative to the file that names it, or to the scene.
    fn path(&self, name: &str, place: &Place) -> PathBuf {
        if let Some(found) = self.paths.iter().rev().map(|folder| folder.join(name)).find(|path| path.exists()) {
            return found;
        }
        let beside = place.file.parent().unwrap_or(Path::new("")).join(name);
        if beside.exists() { beside } else { self.folder.join(name) }
    }

    /// Whether there is a file of this name, wherever it lies.
    pub fn exists(&self, name: &str, place: &Place) -> bool {
        !name.contains('\0') && !name.is_empty() && self.path(name, place).exists()
    }

    /// A file that the scene names; it must lie in the scene's folder.
    pub fn resolve(&self, name: &str, place: &Place) -> Result<PathBuf, ImportError> {
        if name.contains('\0') || name.is_empty() {
            return malformed(place, format!("{name:?} is no file name"));
        }
        let path = self.path(name, place);
        let Ok(canonical) = path.canonicalize() else {
            return malformed(place, format!("file \"{name}\" does not exist beside the scene"));
        };
        inside::check(&canonical, &self.folder, name, place)?;
        Ok(canonical)
    }
}

/// An error at a place.
pub(super) fn malformed<T>(place: &Place, message: impl Into<String>) -> Result<T, ImportError> {
    Err(ImportError::Malformed { place: place.clone(), message: message.into() })
}

/// `$names` and what they stand for.
struct Parameters {
    values: BTreeMap<String, String>,
    unused: Vec<String>,
    /// Bytes of values put in so far.
    expanded: usize,
}

impl Parameters {
    fn new(defines: &[(String, String)]) -> Self {
        Parameters {
            values: defines.iter().cloned().collect(),
            unused: defines.iter().map(|(name, _)| name.clone()).collect(),
            expanded: 0,
        }
    }
    fn unused_define(&self) -> Option<&str> {
        self.unused.first().map(String::as_str)
    }
    fn names(&self) -> String {
        let names: Vec<&str> = self.values.keys().filter(|n| !self.unused.contains(n)).map(String::as_str).collect();
        if names.is_empty() { "none".into() } else { names.join(", ") }
    }
    /// `text` with every `$name` replaced; the longest known name wins (Mitsuba's rule); `\$` is a dollar sign.
    fn substitute(&mut self, text: &str, place: &Place) -> Result<String, ImportError> {
        let mut out = String::new();
        let mut rest = text;
        while let Some(at) = rest.find('$') {
            if rest[..at].ends_with('\\') {
                out.push_str(&rest[..at - 1]);
                out.push('$');
                rest = &rest[at + 1..];
                continue;
            }
            out.push_str(&rest[..at]);
            let after = &rest[at + 1..];
            let known = self.values.iter().filter(|(n, _)| !n.is_empty() && after.starts_with(n.as_str()));
            let Some((name, value)) = known.max_by_key(|(n, _)| n.len()) else {
                let name: String = after.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
                return malformed(place, format!("${name} has no value: add a <default>, or pass -D {name}=VALUE"));
            };
            if out.len() + value.len() > MAX_VALUE {
                return malformed(
                    place,
                    format!(
                        "${name} makes a value of more than {MAX_VALUE} bytes: does its <default> repeat other defaults?"
                    ),
                );
            }
            self.expanded += value.len();
            if self.expanded > MAX_EXPANDED {
                return malformed(
                    place,
                    format!(
                        "with ${name} here, the parameters' values add up to more than {MAX_EXPANDED} bytes in this scene: \
                         write long values once, or shorten the <default>s that repeat others"
                    ),
                );
            }
            out.push_str(value);
            self.unused.retain(|n| n != name);
            rest = &after[name.len()..];
        }
        out.push_str(rest);
        Ok(out)
    }
}

struct Reader {
    document: Document,
    /// Canonical paths of the files being read, outermost first.
    including: Vec<PathBuf>,
    includes: usize,
}

/// One element with its attributes' parameters replaced.
struct Element<'a, 'input> {
    node: roxmltree::Node<'a, 'input>,
    place: Place,
    attributes: BTreeMap<&'a str, String>,
}

impl Element<'_, '_> {
    fn get(&self, name: &str) -> Option<&str> {
        self.attributes.get(name).map(String::as_str)
    }
    fn need(&self, name: &str) -> Result<&str, ImportError> {
        match self.get(name) {
            Some(text) => Ok(text),
            None => malformed(&self.place, format!("<{}> lacks its attribute \"{name}\"", self.node.tag_name().name())),
        }
    }
}

impl Reader {
    /// Reads one file; `parent` takes what is in it, or it becomes the root.
    fn file(
        &mut self,
        path: &Path,
        canonical: &Path,
        parent: Option<(ObjectId, usize, String)>,
        parameters: &mut Parameters,
    ) -> Result<(), ImportError> {
        let io = |source| ImportError::Io { path: path.into(), source };
        let (file, metadata) = regular::open(path).map_err(io)?;
        let left = MAX_BYTES - self.document.bytes_read;
        let mut text = Vec::new();
        // files of /proc have a length of 0 and content all the same
        if metadata.len() <= left {
            file.take(left + 1).read_to_end(&mut text).map_err(io)?;
        }
        if metadata.len().max(text.len() as u64) > left {
            let message =
                format!("more than {MAX_BYTES} bytes of XML with its includes: keep meshes in files of their own");
            return Err(ImportError::Limit { place: Place::file(path), message });
        }
        self.document.bytes_read += text.len() as u64;
        let whole = |message: String| ImportError::Malformed { place: Place::file(path), message };
        let text = String::from_utf8(text).map_err(|e| {
            whole(format!("byte {} is not UTF-8; save the file as UTF-8", e.utf8_error().valid_up_to()))
        })?;
        let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
        if let Some(offset) = crowded_element(text, MAX_ATTRIBUTES) {
            let place = Lines::of(text).place(path, offset.saturating_sub(1));
            return malformed(
                &place,
                format!("an element with more than {MAX_ATTRIBUTES} attributes: it is damaged, get the file again"),
            );
        }
        let options = roxmltree::ParsingOptions { nodes_limit: MAX_NODES, ..Default::default() };
        let lines = Lines::of(text);
        let xml = roxmltree::Document::parse_with_options(text, options).map_err(|e| match e {
            // the parser says no place of it
            roxmltree::Error::DtdDetected => ImportError::Malformed {
                place: lines.place(path, after_prolog(text)),
                message: "a DOCTYPE is not read, as its entities may stand for text without bound: take it out, and write what \
                          they stand for (or a <default>) in their places"
                    .to_owned(),
            },
            roxmltree::Error::NodesLimitReached => ImportError::Limit {
                place: Place::file(path),
                message: format!("more than {MAX_NODES} elements and texts between them: keep meshes in files of their own"),
            },
            e => ImportError::Malformed {
                place: Place { file: path.into(), line: e.pos().row, column: e.pos().col },
                message: format!("not well-formed XML: {e}"),
            },
        })?;
        let place = |node: &roxmltree::Node| lines.place(path, node.range().start);

        self.including.push(canonical.to_path_buf());
        let root = xml.root_element();
        match parent {
            None if root.tag_name().name() != "scene" => {
                let message =
                    format!("the root element is <{}>, not <scene>: this is no Mitsuba scene", root.tag_name().name());
                return malformed(&place(&root), message);
            }
            None => {
                self.document.old = root.attribute("version").is_some_and(|v| v.trim_start().starts_with("0."));
                self.document.objects.push(Object {
                    class: "scene".into(),
                    plugin: "scene".into(),
                    id: None,
                    place: place(&root),
                    properties: vec![],
                });
                self.children(root, 0, 0, parameters, &place)?;
            }
            Some((parent, depth, _)) if root.tag_name().name() == "scene" => {
                self.children(root, parent, depth, parameters, &place)?;
            }
            Some((parent, depth, name)) => {
                let before = self.document.objects[parent].properties.len();
                self.element(root, parent, depth, parameters, &place)?;
                if let Some(property) = self.document.objects[parent].properties.get_mut(before)
                    && property.name.is_empty()
                {
                    property.name = name;
                }
            }
        }
        self.including.pop();
        Ok(())
    }

    fn children(
        &mut self,
        node: roxmltree::Node,
        parent: ObjectId,
        depth: usize,
        parameters: &mut Parameters,
        place: &dyn Fn(&roxmltree::Node) -> Place,
    ) -> Result<(), ImportError> {
        if depth > MAX_DEPTH {
            let message =
                format!("elements nested deeper than {MAX_DEPTH}: give them ids, put them side by side and use <ref>");
            return malformed(&place(&node), message);
        }
        for child in node.children().filter(|n| n.is_element()) {
            self.element(child, parent, depth, parameters, place)?;
        }
        Ok(())
    }

    fn element(
        &mut self,
        node: roxmltree::Node,
        parent: ObjectId,
        depth: usize,
        parameters: &mut Parameters,
        place_of: &dyn Fn(&roxmltree::Node) -> Place,
    ) -> Result<(), ImportError> {
        let place = place_of(&node);
        let element = read_element(node, &place, parameters)?;
        let tag = node.tag_name().name();
        let name = snake_case(element.get("name").unwrap_or(""));
        let parsed = match tag {
            "default" => {
                let (name, value) = (element.need("name")?.to_string(), element.need("value")?.to_string());
                if name.is_empty() {
                    return malformed(&place, "<default> with an empty name");
                }
                parameters.values.entry(name).or_insert(value);
                return Ok(());
            }
            "include" => return self.include(&element, parent, depth, name, parameters),
            "path" => {
                let folder = self.document.resolve(element.need("value")?, &place)?;
                if !folder.is_dir() {
                    return malformed(&place, "<path> should name a folder");
                }
                self.document.paths.push(folder);
                return Ok(());
            }
            "alias" => {
                let (id, alias) = (element.need("id")?, element.need("as")?);
                let Some(&target) = self.document.ids.get(id) else {
                    return malformed(&place, format!("alias of \"{id}\": nothing above has this id"));
                };
                return self.name_object(alias.to_string(), target, &place);
            }
            "ref" => Value::Reference(element.need("id")?.to_string()),
            "float" => Value::Float(value::float(element.need("value")?, &place)?),
            "integer" => Value::Integer(value::integer(element.need("value")?, &place)?),
            "boolean" => Value::Boolean(value::boolean(element.need("value")?, &place)?),
            "string" => Value::String(element.need("value")?.to_string()),
            "vector" | "point" => Value::Vector(value::vector(&|n| element.get(n), 0.0, &place)?),
            "rgb" | "srgb" => value::color(element.need("value")?, tag == "srgb", &place)?,
            "spectrum" if element.get("type").is_none() => match element.get("value") {
                Some(text) => value::spectrum(text, &place)?,
                None => Value::Spectrum(format!("file {}", element.need("filename")?)),
            },
            "blackbody" => Value::Spectrum(format!("blackbody of {}", element.get("temperature").unwrap_or("?"))),
            "transform" => {
                let mut map = Affine::IDENTITY;
                for child in node.children().filter(|n| n.is_element()) {
                    let place = place_of(&child);
                    let child = read_element(child, &place, parameters)?;
                    let step = transform::step(child.node.tag_name().name(), &|n| child.get(n), &place)?;
                    map = step.after(&map);
                }
                if map.0.iter().flatten().any(|x| !x.is_finite()) {
                    return malformed(&place, "this transform has entries that are not finite");
                }
                Value::Transform(map)
            }
            "scene" | "shape" | "bsdf" | "emitter" | "sensor" | "integrator" | "film" | "sampler" | "rfilter"
            | "texture" | "spectrum" | "medium" | "phase" | "volume" | "subsurface" | "camera" | "luminaire" => {
                let id = self.document.objects.len();
                let object = Object {
                    class: tag.to_string(),
                    plugin: element.need("type")?.to_string(),
                    id: element.get("id").map(str::to_string),
                    place: place.clone(),
                    properties: vec![],
                };
                if let Some(text) = object.id.clone() {
                    self.name_object(text, id, &place)?;
                }
                self.document.objects.push(object);
                self.children(node, id, depth + 1, parameters, place_of)?;
                Value::Object(id)
            }
            _ => {
                self.document.unknown.push((place, format!("element <{tag}>")));
                return Ok(());
            }
        };
        self.document.objects[parent].properties.push(Property { name, value: parsed, place, used: Cell::new(false) });
        Ok(())
    }

    fn name_object(&mut self, name: String, id: ObjectId, place: &Place) -> Result<(), ImportError> {
        if self.document.ids.contains_key(&name) {
            return malformed(place, format!("the id \"{name}\" is taken already: give each object its own"));
        }
        self.document.ids.insert(name, id);
        Ok(())
    }

    fn include(
        &mut self,
        element: &Element,
        parent: ObjectId,
        depth: usize,
        name: String,
        parameters: &mut Parameters,
    ) -> Result<(), ImportError> {
        let path = self.document.resolve(element.need("filename")?, &element.place)?;
        if let Some(start) = self.including.iter().position(|p| *p == path) {
            let cycle: Vec<String> = self.including[start..].iter().chain([&path]).map(|p| file_name(p)).collect();
            return malformed(
                &element.place,
                format!("includes form a cycle: {}; take one of these <include>s out", cycle.join(" -> ")),
            );
        }
        self.includes += 1;
        if self.includes > MAX_INCLUDES || self.including.len() > MAX_DEPTH {
            let message =
                format!("more than {MAX_INCLUDES} includes, or deeper than {MAX_DEPTH}: join some of the files");
            return malformed(&element.place, message);
        }
        self.file(&path.clone(), &path, Some((parent, depth + 1, name)), parameters)
    }
}

fn file_name(path: &Path) -> String {
    path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}

fn read_element<'a, 'input>(
    node: roxmltree::Node<'a, 'input>,
    place: &Place,
    parameters: &mut Parameters,
) -> Result<Element<'a, 'input>, ImportError> {
    let mut attributes = BTreeMap::new();
    for attribute in node.attributes() {
        attributes.insert(attribute.name(), parameters.substitute(attribute.value(), place)?);
    }
    Ok(Element { node, place: place.clone(), attributes })
}
