//! A file being read once from front to back, in bounded memory; gzip is unpacked on the way.

use std::fs::File;
use std::io::{self, Chain, Cursor, Read, Seek, SeekFrom};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use flate2::read::{MultiGzDecoder, ZlibDecoder};

use super::regular;
use crate::ImportError;
use crate::description::Place;

/// Bytes in memory; also the longest line.
const BUFFER: usize = 256 << 10;
/// The same where only the first lines are wanted.
const HEAD: usize = 4 << 10;
/// Longest word of a text format.
const MAX_TOKEN: usize = 256;
/// DEFLATE never makes more than this many bytes of one (RFC 1951: a 258-byte match takes at least 2 bits).
const MAX_EXPANSION: u64 = 1032;

/// A file, its buffer, and where in it we are.
pub(super) struct Source {
    path: PathBuf,
    input: Input,
    buffer: Box<[u8]>,
    start: usize,
    end: usize,
    /// Of `buffer[start]`, in unpacked bytes.
    offset: u64,
    /// Line of the last word or line read, from 1.
    line: u32,
    /// Offsets of that line, and of the last word read.
    line_start: u64,
    word_start: u64,
    file_length: u64,
    /// Bytes read at a time.
    chunk: usize,
}

enum Input {
    Plain(Counting),
    /// After the two bytes that told it.
    Gzip(Box<MultiGzDecoder<Chain<Cursor<[u8; 2]>, Counting>>>),
    /// From the place in the file where it was told to begin.
    Zlib(Box<ZlibDecoder<Counting>>),
}

/// A file that counts what is read.
struct Counting(File, u64);

impl Read for Counting {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let n = self.0.read(buffer)?;
        self.1 += n as u64;
        Ok(n)
    }
}

impl Source {
    /// Opens a regular file.
    pub fn open(path: &Path) -> Result<Source, ImportError> {
        let io = |source| ImportError::Io { path: path.into(), source };
        let (file, metadata) = regular::open(path).map_err(io)?;
        let mut file = Counting(file, 0);
        let mut first = Vec::with_capacity(2);
        file.by_ref().take(2).read_to_end(&mut first).map_err(io)?;
        let mut buffer = vec![0; BUFFER].into_boxed_slice();
        // nothing is read twice: the first bytes go where they belong
        let (input, end) = match first[..] {
            [a @ 0x1f, b @ 0x8b] => (Input::Gzip(Box::new(MultiGzDecoder::new(Cursor::new([a, b]).chain(file)))), 0),
            _ => {
                buffer[..first.len()].copy_from_slice(&first);
                (Input::Plain(file), first.len())
            }
        };
        Ok(Source {
            path: path.into(),
            input,
            buffer,
            start: 0,
            end,
            offset: 0,
            line: 0,
            line_start: 0,
            word_start: 0,
            file_length: metadata.len(),
            chunk: BUFFER,
        })
    }

    /// Opens a regular file of which only the first lines are wanted.
    pub fn open_head(path: &Path) -> Result<Source, ImportError> {
        Ok(Source { chunk: HEAD, ..Source::open(path)? })
    }

    /// Bytes read from disk, packed ones for gzip.
    pub fn bytes_read(&self) -> u64 {
        match &self.input {
            Input::Plain(file) => file.1,
            Input::Gzip(decoder) => decoder.get_ref().get_ref().1.1,
            Input::Zlib(decoder) => decoder.get_ref().1,
        }
    }

    /// Length of the content, if that is known before reading it.
    pub fn length(&self) -> Option<u64> {
        matches!(self.input, Input::Plain(_)).then_some(self.file_length)
    }

    /// No more than this many bytes can still come.
    pub fn most_left(&self) -> u64 {
        self.length().unwrap_or(self.file_length.saturating_mul(MAX_EXPANSION)).saturating_sub(self.offset)
    }

    /// Where we are, in unpacked bytes.
    pub fn offset(&self) -> u64 {
        self.offset
    }

    /// Reads bytes at a place of a file that is not packed, wherever the reading is.
    pub fn read_at(&mut self, offset: u64, out: &mut [u8]) -> Result<(), ImportError> {
        let Input::Plain(file) = &mut self.input else {
            return self.fail_byte("places in a packed file cannot be looked up: unpack it");
        };
        match file.0.read_exact_at(out, offset) {
            Ok(()) => file.1 += out.len() as u64,
            Err(e) => return Err(ImportError::Io { path: self.path.clone(), source: e }),
        }
        Ok(())
    }

    /// The zlib data that begin at a byte of a file that is not packed otherwise.
    pub fn into_zlib(self, at: u64) -> Result<Source, ImportError> {
        if !matches!(self.input, Input::Plain(_)) {
            return self.fail_byte("packed twice: unpack it once");
        }
        let Input::Plain(mut file) = self.input else { unreachable!("looked at above") };
        file.0.seek(SeekFrom::Start(at)).map_err(|source| ImportError::Io { path: self.path.clone(), source })?;
        let input = Input::Zlib(Box::new(ZlibDecoder::new(file)));
        Ok(Source { input, start: 0, end: 0, offset: 0, ..self })
    }

    /// The file and the last line read.
    pub fn place(&self) -> (&Path, u32) {
        (&self.path, self.line)
    }

    /// An error at the last word read, or where the file ends if none is left.
    pub fn fail_word<T>(&self, message: impl Into<String>) -> Result<T, ImportError> {
        self.fail_at(self.word_start.saturating_sub(self.line_start) as usize, message)
    }

    /// An error so many bytes after the start of the last line read.
    pub fn fail_at<T>(&self, at: usize, message: impl Into<String>) -> Result<T, ImportError> {
        self.fail_in(self.line, at, message)
    }

    /// An error so many bytes after the start of a line.
    pub fn fail_in<T>(&self, line: u32, at: usize, message: impl Into<String>) -> Result<T, ImportError> {
        let place = Place::line(&self.path, line.max(1)).at(at);
        Err(ImportError::Malformed { place, message: message.into() })
    }

    /// An error at a byte.
    pub fn fail_byte<T>(&self, message: impl std::fmt::Display) -> Result<T, ImportError> {
        let place = Place::file(&self.path);
        Err(ImportError::Malformed { place, message: format!("byte {}: {message}", self.offset) })
    }

    /// An error about a limit.
    pub fn fail_limit<T>(&self, message: impl Into<String>) -> Result<T, ImportError> {
        Err(ImportError::Limit { place: Place::file(&self.path), message: message.into() })
    }

    /// Wraps an error of the operating system.
    pub fn io(&self, source: io::Error) -> ImportError {
        ImportError::Io { path: self.path.clone(), source }
    }

    /// Brings at least `n` bytes into the buffer, or as many as there are.
    fn fill(&mut self, n: usize) -> Result<(), ImportError> {
        debug_assert!(n <= BUFFER);
        if self.end - self.start >= n {
            return Ok(());
        }
        self.buffer.copy_within(self.start..self.end, 0);
        self.end -= self.start;
        self.start = 0;
        while self.end < n {
            let most = self.buffer.len().min(self.end.saturating_add(self.chunk));
            let room = &mut self.buffer[self.end..most];
            let result = match &mut self.input {
                Input::Plain(file) => file.read(room),
                Input::Gzip(decoder) => decoder.read(room),
                Input::Zlib(decoder) => decoder.read(room),
            };
            match result {
                Ok(0) => break,
                Ok(k) => self.end += k,
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                // an error of the disk has a number, one of the packed data has none
                Err(e) if !matches!(self.input, Input::Plain(_)) && e.raw_os_error().is_none() => {
                    return self.fail_byte(format!("the packed data is cut off or broken ({e}): get the file again"));
                }
                Err(e) => return Err(ImportError::Io { path: self.path.clone(), source: e }),
            }
        }
        Ok(())
    }

    /// Up to `n` of the next bytes, without passing them; fewer at the end.
    pub fn peek(&mut self, n: usize) -> Result<&[u8], ImportError> {
        self.fill(n)?;
        Ok(&self.buffer[self.start..self.end.min(self.start + n)])
    }

    fn pass(&mut self, n: usize) {
        self.start += n;
        self.offset += n as u64;
    }

    /// The next `n` bytes (no more than 4096); it is an error when the file ends before.
    #[inline]
    pub fn exact(&mut self, n: usize) -> Result<&[u8], ImportError> {
        if self.end - self.start < n {
            self.fill(n)?;
            if self.end - self.start < n {
                self.pass(self.end - self.start);
                return self.fail_byte("the file ends in the middle of its data: it is truncated, get it again");
            }
        }
        let at = self.start;
        self.pass(n);
        Ok(&self.buffer[at..at + n])
    }

    /// Passes `n` bytes.
    pub fn skip(&mut self, mut n: u64) -> Result<(), ImportError> {
        while n > 0 {
            let step = n.min(4096) as usize;
            self.exact(step)?;
            n -= step as u64;
        }
        Ok(())
    }

    /// The next line without its end (`\n` or `\r\n`); none at the end of the file.
    pub fn line_bytes(&mut self) -> Result<Option<&[u8]>, ImportError> {
        self.line_start = self.offset;
        let mut searched = 0;
        let length = loop {
            match self.buffer[self.start + searched..self.end].iter().position(|b| *b == b'\n') {
                Some(at) => break searched + at,
                None => {
                    searched = self.end - self.start;
                    if searched == BUFFER {
                        self.line += 1;
                        let message = format!("a line longer than {BUFFER} bytes: this is no text file of this format");
                        return self.fail_at(0, message);
                    }
                    self.fill(searched + 1)?;
                    if self.end - self.start == searched {
                        if searched == 0 {
                            return Ok(None);
                        }
                        break searched;
                    }
                }
            }
        };
        let at = self.start;
        let ended = at + length < self.end;
        self.pass(length + usize::from(ended));
        self.line += 1;
        let line = &self.buffer[at..at + length];
        Ok(Some(line.strip_suffix(b"\r").unwrap_or(line)))
    }

    /// The next word between white space; none at the end of the file. Counts lines from the last [`Source::line_bytes`].
    #[inline]
    pub fn token(&mut self) -> Result<Option<&[u8]>, ImportError> {
        // nearly every word lies in the buffer with what ends it
        let have = &self.buffer[self.start..self.end];
        let (mut first, mut lines, mut begins) = (0, 0, 0);
        while first < have.len() && is_blank(have[first]) {
            if have[first] == b'\n' {
                (lines, begins) = (lines + 1, first + 1);
            }
            first += 1;
        }
        let mut after = first;
        while after < have.len() && !is_blank(have[after]) {
            after += 1;
        }
        if lines > 0 {
            (self.line, self.line_start) = (self.line + lines, self.offset + begins as u64);
        }
        self.pass(first);
        self.word_start = self.offset;
        if self.start + (after - first) < self.end && after - first <= MAX_TOKEN {
            let at = self.start;
            self.pass(after - first);
            return Ok(Some(&self.buffer[at..at + (after - first)]));
        }
        self.token_at_end()
    }

    /// A word that the buffer may end in.
    #[cold]
    fn token_at_end(&mut self) -> Result<Option<&[u8]>, ImportError> {
        loop {
            if self.start == self.end {
                self.fill(1)?;
                if self.start == self.end {
                    self.word_start = self.offset;
                    return Ok(None);
                }
            }
            let byte = self.buffer[self.start];
            if !is_blank(byte) {
                break;
            }
            self.pass(1);
            if byte == b'\n' {
                (self.line, self.line_start) = (self.line + 1, self.offset);
            }
        }
        self.word_start = self.offset;
        let mut length = 1;
        loop {
            let have = &self.buffer[self.start..self.end];
            match have[length..].iter().position(|b| is_blank(*b)) {
                Some(n) => {
                    length += n;
                    break;
                }
                None if have.len() > MAX_TOKEN => {
                    length = have.len();
                    break;
                }
                None => {
                    length = have.len();
                    self.fill(length + 1)?;
                    if self.end - self.start == length {
                        break;
                    }
                }
            }
        }
        if length > MAX_TOKEN {
            return self
                .fail_word(format!("a word longer than {MAX_TOKEN} bytes: this is no text file of this format"));
        }
        let at = self.start;
        self.pass(length);
        Ok(Some(&self.buffer[at..at + length]))
    }

    /// Passes the rest of a line, of any length.
    pub fn rest_of_line(&mut self) -> Result<(), ImportError> {
        loop {
            self.fill(1)?;
            let have = &self.buffer[self.start..self.end];
            match have.iter().position(|b| *b == b'\n') {
                // the line end is counted by the next word
                Some(n) => {
                    self.pass(n);
                    return Ok(());
                }
                None if have.is_empty() => return Ok(()),
                None => self.pass(have.len()),
            }
        }
    }

    /// After reading lines, before reading words: we are in the line after the last one read.
    pub fn begin_tokens(&mut self) {
        self.line += 1;
        self.line_start = self.offset;
    }
}

/// The words of a line, which white space is between.
pub(super) struct Words<'l> {
    rest: &'l [u8],
    length: usize,
    at: usize,
}

impl<'l> Words<'l> {
    pub fn new(line: &'l [u8]) -> Self {
        Words { rest: line, length: line.len(), at: 0 }
    }

    /// How many bytes of the line stand before the last word.
    pub fn at(&self) -> usize {
        self.at
    }
}

impl<'l> Iterator for Words<'l> {
    type Item = &'l [u8];

    #[inline]
    fn next(&mut self) -> Option<&'l [u8]> {
        let first = self.rest.iter().position(|b| !is_blank(*b))?;
        let rest = &self.rest[first..];
        self.at = self.length - rest.len();
        let (word, rest) = rest.split_at(rest.iter().position(|b| is_blank(*b)).unwrap_or(rest.len()));
        self.rest = rest;
        Some(word)
    }
}

/// White space as [`u8::is_ascii_whitespace`] has it; most bytes are told by the first comparison.
#[inline]
fn is_blank(byte: u8) -> bool {
    byte <= b' ' && byte.is_ascii_whitespace()
}

/// Text for a message: short, and without control characters.
pub(super) fn show(text: &[u8]) -> String {
    let text = String::from_utf8_lossy(&text[..text.len().min(60)]);
    text.chars().map(|c| if c.is_control() { '?' } else { c }).collect()
}
