//! NRRD: attached or detached (NHDR) data, raw or gzip. Format: <https://teem.sourceforge.net/nrrd/format.html>.

use std::io::{BufRead, BufReader, Read};
use std::path::{Component, Path, PathBuf};

use super::layout::{Layout, Part, Skip, check_dims};
use super::slices::{Bytes, Counted};
use super::{SampleType, Volume, malformed};
use crate::ImportError;
use crate::description::{Affine, Place};

/// Longest header: room for a list of many thousand files.
const MAX_HEADER: u64 = 1 << 20;
/// Most bytes of all names that a numbered list of files makes.
const MAX_NAMES: i128 = 1 << 24;

/// Fields of the format that say nothing we need.
const IGNORED: &[&str] = &[
    "content",
    "number",
    "min",
    "max",
    "old min",
    "old max",
    "block size",
    "sample units",
    "thicknesses",
    "axis mins",
    "axis maxs",
    "centers",
    "centerings",
    "labels",
    "units",
    "kinds",
    "space units",
    "measurement frame",
];

/// Signs to LPS where the header says nothing of orientation: the first slice is on top, as scanners number them (the
/// patient's head), and rows run to the patient's right. A half turn around y, which mirrors nothing.
const UNORIENTED: [f64; 3] = [-1.0, 1.0, -1.0];

#[derive(Default)]
struct Header {
    dimension: Option<u64>,
    sample: Option<SampleType>,
    sizes: Vec<u64>,
    sizes_line: u32,
    big_endian: Option<bool>,
    gzip: Option<bool>,
    spacings: Option<Vec<f64>>,
    directions: Option<Vec<[f64; 3]>>,
    origin: Option<[f64; 3]>,
    /// Signs that turn the file's space into LPS.
    signs: Option<[f64; 3]>,
    line_skip: u64,
    byte_skip: i64,
    /// Line of `data file`, and the files.
    data: Option<(u32, Vec<String>)>,
}

pub(super) fn open(path: &Path, bytes: &Bytes) -> Result<(Volume, Layout), ImportError> {
    let io = |source| ImportError::Io { path: path.to_owned(), source };
    let mut reader = BufReader::new(Counted::open(path, bytes).map_err(io)?.take(MAX_HEADER + 1));
    let mut text = Vec::new();
    let mut h = Header::default();
    let mut line = 0;
    let mut used = 0;
    let mut listing = false;
    loop {
        text.clear();
        let n = reader.read_until(b'\n', &mut text).map_err(io)?;
        used += n as u64;
        line += 1;
        if used > MAX_HEADER {
            return Err(ImportError::Limit {
                place: Place::line(path, line),
                message: format!("the header has more than {MAX_HEADER} bytes"),
            });
        }
        let Ok(row) = std::str::from_utf8(&text) else {
            return Err(malformed(path, line, "the header is not text"));
        };
        let row = row.trim_end_matches(['\n', '\r']);
        if line == 1 {
            let version = row.strip_prefix("NRRD000").and_then(|v| v.parse::<u8>().ok());
            if !version.is_some_and(|v| (1..=5).contains(&v)) {
                return Err(malformed(path, 1, "the first line is not one of NRRD0001 to NRRD0005"));
            }
        } else if n == 0 || row.is_empty() {
            break;
        } else if let (true, Some((_, files))) = (listing, &mut h.data) {
            files.push(row.to_owned());
        } else if !row.starts_with('#') {
            field(&mut h, row, line, &mut listing).map_err(|message| malformed(path, line, message))?;
        }
    }
    finish(path, h, used, u64::from(line))
}

/// One line of the header.
fn field(h: &mut Header, row: &str, line: u32, listing: &mut bool) -> Result<(), String> {
    let Some((name, value)) = row.split_once(':') else {
        return Err("not a field: expected `name: value`".into());
    };
    if value.starts_with('=') {
        return Ok(()); // a key with a value: whoever wrote it knows why
    }
    let value = value.trim();
    let name = name.trim().to_ascii_lowercase();
    match name.as_str() {
        "dimension" => h.dimension = Some(number(value)?),
        "type" => h.sample = Some(sample_type(value)?),
        "sizes" => {
            h.sizes = value.split_whitespace().map(number).collect::<Result<_, _>>()?;
            h.sizes_line = line;
        }
        "endian" => {
            h.big_endian = Some(match value {
                "little" => false,
                "big" => true,
                _ => return Err(format!("endian is `{value}`, not little or big")),
            });
        }
        "encoding" => {
            h.gzip = Some(match value.to_ascii_lowercase().as_str() {
                "raw" => false,
                "gzip" | "gz" => true,
                _ => {
                    return Err(format!(
                        "encoding `{value}` is not supported: convert to raw or gzip (`unu save -e gzip`)"
                    ));
                }
            });
        }
        "spacings" => h.spacings = Some(value.split_whitespace().map(number).collect::<Result<_, _>>()?),
        "space directions" => h.directions = Some(vectors(value)?),
        "space origin" => {
            let v = vectors(value)?;
            let [origin] = v[..] else { return Err("space origin is not one vector".into()) };
            h.origin = Some(origin);
        }
        "space" => h.signs = Some(space(value)?),
        "space dimension" => {
            if number::<u64>(value)? != 3 {
                return Err("space dimension is not 3".into());
            }
        }
        "line skip" | "lineskip" => h.line_skip = number(value)?,
        "byte skip" | "byteskip" => {
            h.byte_skip = number(value)?;
            if h.byte_skip < -1 {
                return Err("byte skip is below -1".into());
            }
        }
        "data file" | "datafile" => {
            h.data = Some((line, data_files(value)?));
            *listing = value.starts_with("LIST");
        }
        _ if IGNORED.contains(&name.as_str()) => {}
        _ => return Err(format!("unknown field `{name}`")),
    }
    Ok(())
}

fn number<T: std::str::FromStr>(text: &str) -> Result<T, String> {
    text.parse().map_err(|_| format!("`{text}` is not a number of the kind that belongs here"))
}

fn sample_type(name: &str) -> Result<SampleType, String> {
    Ok(match name {
        "signed char" | "int8" | "int8_t" => SampleType::I8,
        "uchar" | "unsigned char" | "uint8" | "uint8_t" => SampleType::U8,
        "short" | "short int" | "signed short" | "signed short int" | "int16" | "int16_t" => SampleType::I16,
        "ushort" | "unsigned short" | "unsigned short int" | "uint16" | "uint16_t" => SampleType::U16,
        "int" | "signed int" | "int32" | "int32_t" => SampleType::I32,
        "uint" | "unsigned int" | "uint32" | "uint32_t" => SampleType::U32,
        "longlong"
        | "long long"
        | "long long int"
        | "signed long long"
        | "signed long long int"
        | "int64"
        | "int64_t" => SampleType::I64,
        "ulonglong" | "unsigned long long" | "unsigned long long int" | "uint64" | "uint64_t" => SampleType::U64,
        "float" => SampleType::F32,
        "double" => SampleType::F64,
        _ => return Err(format!("type `{name}` is not supported: integers of 8 to 64 bits, float and double are")),
    })
}

/// Signs to LPS. A space without anatomy is taken as it is; a left-handed one has x negated, so that nothing is seen mirrored.
fn space(name: &str) -> Result<[f64; 3], String> {
    let lower = name.to_ascii_lowercase();
    match lower.as_str() {
        "scanner-xyz" | "3d-right-handed" => return Ok([1.0; 3]),
        "3d-left-handed" => return Ok([-1.0, 1.0, 1.0]),
        _ => {}
    }
    let words: Vec<&str> = if lower.len() == 3 {
        (0..3).map(|k| lower.get(k..k + 1).unwrap_or("")).collect()
    } else {
        lower
            .split('-')
            .map(|w| match w {
                "left" => "l",
                "right" => "r",
                "posterior" => "p",
                "anterior" => "a",
                "superior" => "s",
                _ => "",
            })
            .collect()
    };
    let sign = |k: usize, plus: &str, minus: &str| match words.get(k) {
        Some(&w) if w == plus => Some(1.0),
        Some(&w) if w == minus => Some(-1.0),
        _ => None,
    };
    match (words.len(), sign(0, "l", "r"), sign(1, "p", "a"), sign(2, "s", "i")) {
        (3, Some(x), Some(y), Some(z)) => Ok([x, y, z]),
        _ => Err(format!("space `{name}` is not supported: three-dimensional spaces are")),
    }
}

/// Vectors of three numbers: `(a,b,c) (d,e,f)`.
fn vectors(text: &str) -> Result<Vec<[f64; 3]>, String> {
    let bad = || format!("`{text}` are not vectors of three numbers, (x,y,z)");
    let mut rest = text.trim();
    let mut out = Vec::new();
    while !rest.is_empty() {
        let inner = rest.strip_prefix('(').ok_or_else(bad)?;
        let (vector, after) = inner.split_once(')').ok_or_else(bad)?;
        let numbers: Vec<f64> =
            vector.split(',').map(|n| n.trim().parse().map_err(|_| bad())).collect::<Result<_, _>>()?;
        let v: [f64; 3] = numbers.try_into().map_err(|_| bad())?;
        if !v.iter().all(|n| n.is_finite()) {
            return Err(bad());
        }
        out.push(v);
        rest = after.trim_start();
    }
    Ok(out)
}

/// `name`, `format first last step [dimension]` or `LIST [dimension]` (whose names follow).
fn data_files(value: &str) -> Result<Vec<String>, String> {
    let words: Vec<&str> = value.split_whitespace().collect();
    if words.first() == Some(&"LIST") {
        return Ok(Vec::new());
    }
    if !(words.len() == 4 || words.len() == 5) || !words[0].contains('%') {
        return Ok(vec![value.to_owned()]);
    }
    let (first, last, step): (i64, i64, i64) = (number(words[1])?, number(words[2])?, number(words[3])?);
    if step == 0 || (last > first) != (step > 0) && last != first {
        return Err(format!("numbers from {first} to {last} cannot be had in steps of {step}"));
    }
    let count = (i128::from(last) - i128::from(first)) / i128::from(step) + 1;
    // every name is kept
    if count * (words[0].len() as i128 + 32) > MAX_NAMES {
        return Err(format!("{count} data files are too many: their names may have {MAX_NAMES} bytes"));
    }
    (0..count as i64).map(|i| numbered(words[0], first + i * step)).collect()
}

/// printf of one number by `%d`, `%4d` or `%04d`.
fn numbered(format: &str, n: i64) -> Result<String, String> {
    let bad = || format!("`{format}` is not a file name with one %d (or %03d)");
    let (before, rest) = format.split_once('%').ok_or_else(bad)?;
    let (spec, after) = rest.split_once('d').ok_or_else(bad)?;
    let width: usize = if spec.is_empty() { 0 } else { spec.parse().map_err(|_| bad())? };
    if after.contains('%') || width > 32 {
        return Err(bad());
    }
    Ok(if spec.starts_with('0') { format!("{before}{n:0width$}{after}") } else { format!("{before}{n:width$}{after}") })
}

/// `length` and `lines` are those of the header, its closing empty line included.
fn finish(path: &Path, h: Header, length: u64, lines: u64) -> Result<(Volume, Layout), ImportError> {
    let need = |name: &str| malformed(path, 0, format!("the header has no field `{name}`"));
    if h.dimension.ok_or_else(|| need("dimension"))? != 3 {
        return Err(malformed(path, 0, "the dimension is not 3: cut a volume out first (`unu slice`)"));
    }
    let sample = h.sample.ok_or_else(|| need("type"))?;
    let gzip = h.gzip.ok_or_else(|| need("encoding"))?;
    let sizes: [u64; 3] =
        h.sizes[..].try_into().map_err(|_| malformed(path, h.sizes_line, "`sizes` has not three numbers"))?;
    let dims = check_dims(path, h.sizes_line, sizes)?;
    let big_endian = match h.big_endian {
        Some(e) => e,
        None if sample.bytes() == 1 => false,
        None => return Err(need("endian")),
    };
    let skip = match (h.byte_skip, gzip) {
        (-1, false) if h.line_skip == 0 => Skip::FromEnd,
        (-1, _) => return Err(malformed(path, 0, "byte skip -1 goes with raw data and no line skip only")),
        (n, _) => Skip::Lines(h.line_skip, n as u64),
    };
    let part = |path: PathBuf, slices: usize, skip: Skip| Part { path, slices, skip, gzip, slope: 1.0, intercept: 0.0 };
    let parts = match &h.data {
        // attached: what is to be skipped comes after the header
        None => {
            let skip = match skip {
                Skip::Lines(0, n) if !gzip => Skip::Lines(0, length.saturating_add(n)),
                Skip::FromEnd => Skip::FromEnd,
                Skip::Lines(more, n) => Skip::Lines(lines.saturating_add(more), n),
            };
            vec![part(path.to_owned(), dims[2], skip)]
        }
        Some((line, files)) => {
            if files.is_empty() || !dims[2].is_multiple_of(files.len()) {
                return Err(malformed(
                    path,
                    *line,
                    format!("{} data files do not hold {} slices evenly", files.len(), dims[2]),
                ));
            }
            let slices = dims[2] / files.len();
            files
                .iter()
                .map(|f| Ok(part(inside_folder(path, *line, f)?, slices, skip)))
                .collect::<Result<_, ImportError>>()?
        }
    };
    let layout = Layout { slice_samples: dims[0] * dims[1], sample, big_endian, bits: None, parts };
    layout.check(path)?;
    let to_world = placement(path, &h)?;
    let volume = Volume { dims, to_world, slope: 1.0, intercept: 0.0, sample, skipped_files: 0 };
    Ok((volume, layout))
}

/// A data file, which must not leave the header's folder, by links neither.
fn inside_folder(header: &Path, line: u32, name: &str) -> Result<PathBuf, ImportError> {
    let name = Path::new(name.trim());
    let outside = || {
        let message = format!("data file {} is outside the header's folder: put it beside the header", name.display());
        malformed(header, line, message)
    };
    let plain = name.components().all(|c| matches!(c, Component::Normal(_) | Component::CurDir));
    if !plain || name.as_os_str().is_empty() {
        return Err(outside());
    }
    let folder = match header.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let path = folder.join(name);
    let canonical = |path: &Path| path.canonicalize().map_err(|source| ImportError::Io { path: path.into(), source });
    if canonical(&path)?.starts_with(canonical(folder)?) { Ok(path) } else { Err(outside()) }
}

fn placement(path: &Path, h: &Header) -> Result<Affine, ImportError> {
    let columns = match (&h.directions, &h.spacings) {
        (Some(d), _) => <[[f64; 3]; 3]>::try_from(&d[..])
            .map_err(|_| malformed(path, 0, "`space directions` has not three vectors"))?,
        (None, Some(s)) => {
            let s: [f64; 3] = s[..].try_into().map_err(|_| malformed(path, 0, "`spacings` has not three numbers"))?;
            if !s.iter().all(|&d| d.is_finite() && d > 0.0) {
                return Err(malformed(
                    path,
                    0,
                    "a spacing is not a positive number: put the distance of the samples there",
                ));
            }
            std::array::from_fn(|c| std::array::from_fn(|r| if r == c { s[c] } else { 0.0 }))
        }
        (None, None) => std::array::from_fn(|c| std::array::from_fn(|r| f64::from(u8::from(r == c)))),
    };
    let signs = match (h.signs, &h.directions) {
        (Some(signs), _) => signs,
        (None, Some(_)) => [1.0; 3],
        (None, None) => UNORIENTED,
    };
    let origin = h.origin.unwrap_or([0.0; 3]);
    super::affine(path, |r, c| signs[r] * columns[c][r], |r| signs[r] * origin[r])
}
