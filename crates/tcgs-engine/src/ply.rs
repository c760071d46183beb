//! Headers of PLY files: encoding, number of vertices, and the properties of a vertex.
//!
//! A header is at most [`MAX_HEADER_BYTES`] long. Its claims are not trusted: callers check counts against the bytes that follow.

use std::{
    borrow::Cow,
    io::{self, BufRead, Read as _},
};

use thiserror::Error;

/// Longest header that is read; real ones have some 1 500 bytes.
pub const MAX_HEADER_BYTES: usize = 64 << 10;

/// What a reader accepts besides the properties that it uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Profile {
    /// A file of plain Gaussians: binary little endian 1.0, vertices only, no line that PLY does not define.
    Gaussians,
    /// A point cloud of any program: any encoding, further elements after the vertices, further lines.
    Points,
}

/// How the data is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Encoding {
    /// Numbers as text.
    Ascii,
    /// Binary, least significant byte first.
    LittleEndian,
    /// Binary, most significant byte first.
    BigEndian,
}

/// A number type of fixed size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scalar {
    /// `char`, `int8`.
    I8,
    /// `uchar`, `uint8`.
    U8,
    /// `short`, `int16`.
    I16,
    /// `ushort`, `uint16`.
    U16,
    /// `int`, `int32`.
    I32,
    /// `uint`, `uint32`.
    U32,
    /// `float`, `float32`.
    F32,
    /// `double`, `float64`.
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// Bytes of a value in binary encodings.
    #[must_use]
    pub fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The value in the first bytes of `bytes`, which hold at least [`Scalar::size`].
    #[must_use]
    pub fn read(self, bytes: &[u8], encoding: Encoding) -> f64 {
        let mut raw = [0; 8];
        let size = self.size();
        raw[..size].copy_from_slice(&bytes[..size]);
        if encoding == Encoding::BigEndian {
            raw[..size].reverse();
        }
        let [a, b, c, d, ..] = raw;
        match self {
            Self::I8 => f64::from(a as i8),
            Self::U8 => f64::from(a),
            Self::I16 => f64::from(i16::from_le_bytes([a, b])),
            Self::U16 => f64::from(u16::from_le_bytes([a, b])),
            Self::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            Self::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            Self::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            Self::F64 => f64::from_le_bytes(raw),
        }
    }
}

/// Why a header is refused.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum HeaderError {
    /// The first line is another.
    #[error("the file does not start with 'ply'")]
    NotPly,
    /// No `end_header` where one should be.
    #[error("the header has no end_header in its first {MAX_HEADER_BYTES} bytes")]
    Unterminated,
    /// A line that PLY does not define, or a count that is no number.
    #[error("header line {number} is not understood: '{line:.60}'")]
    Line {
        /// From 1.
        number: usize,
        /// Its text.
        line: String,
    },
    /// An encoding that is not read.
    #[error("the format '{0:.40}' is not supported")]
    Encoding(String),
    /// An element other than the vertices, or a second one of vertices, where only vertices are read.
    #[error("element '{0:.40}' where only one element, the vertices, is expected")]
    Element(String),
    /// The header has no format or no vertices.
    #[error("the header lacks its {0}")]
    Missing(&'static str),
    /// A list, or a type that PLY does not define.
    #[error("property '{name:.40}' is of the unsupported type '{kind:.40}'")]
    PropertyType {
        /// Name of the property.
        name: String,
        /// Its type.
        kind: String,
    },
    /// Two properties of one name.
    #[error("property '{0:.40}' comes twice")]
    Twice(String),
}

/// A property of a vertex.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Property {
    /// Name, as written.
    pub name: String,
    /// Type.
    pub scalar: Scalar,
    /// First byte in a vertex of a binary encoding.
    pub offset: usize,
}

/// A parsed header.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Header {
    /// How the data is written.
    pub encoding: Encoding,
    /// Number of vertices as claimed.
    pub vertices: u64,
    /// Properties of a vertex in file order.
    pub properties: Vec<Property>,
    /// Bytes of a vertex in a binary encoding.
    pub stride: usize,
    /// Bytes of the header, `end_header` and its line end included.
    pub length: usize,
}

impl Header {
    /// Reads a header from a stream, `end_header` included, or the first [`MAX_HEADER_BYTES`] if there is none.
    ///
    /// # Errors
    /// Those of the reader.
    pub fn read_bytes(reader: &mut dyn BufRead) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        loop {
            let start = bytes.len();
            (&mut *reader).take((MAX_HEADER_BYTES - start) as u64).read_until(b'\n', &mut bytes)?;
            if bytes.last() != Some(&b'\n')
                || bytes.len() == start
                || bytes[start..].trim_ascii() == b"end_header"
            {
                return Ok(bytes);
            }
        }
    }

    /// Parses the header at the front of `bytes`.
    ///
    /// # Errors
    /// [`HeaderError`], one variant for each thing that can be wrong.
    pub fn parse(bytes: &[u8], profile: Profile) -> Result<Self, HeaderError> {
        let strict = profile == Profile::Gaussians;
        let (mut encoding, mut vertices, mut in_vertex) = (None, None, false);
        let (mut properties, mut stride, mut length) = (Vec::<Property>::new(), 0, 0);
        for number in 1.. {
            let rest = &bytes[length..bytes.len().min(MAX_HEADER_BYTES)];
            let end = rest.iter().position(|byte| *byte == b'\n');
            let text = String::from_utf8_lossy(&rest[..end.unwrap_or(rest.len().min(80))]);
            let words: Vec<&str> = text.split_ascii_whitespace().collect();
            if number == 1 && words != ["ply"] {
                return Err(HeaderError::NotPly);
            }
            length += end.ok_or(HeaderError::Unterminated)? + 1;
            let not_understood = || HeaderError::Line { number, line: text.to_string() };
            if !strict && matches!(text, Cow::Owned(_)) {
                return Err(not_understood());
            }
            match words[..] {
                ["ply"] if number == 1 => {}
                ["comment" | "obj_info", ..] => {}
                ["format", "binary_little_endian", "1.0"] => encoding = Some(Encoding::LittleEndian),
                ["format", "ascii", _] if !strict => encoding = Some(Encoding::Ascii),
                ["format", "binary_little_endian", _] if !strict => encoding = Some(Encoding::LittleEndian),
                ["format", "binary_big_endian", _] if !strict => encoding = Some(Encoding::BigEndian),
                ["format", ..] => return Err(HeaderError::Encoding(words[1..].join(" "))),
                ["element", "vertex", count] if vertices.is_none() => {
                    vertices = Some(count.parse::<u64>().map_err(|_| not_understood())?);
                    in_vertex = true;
                }
                ["element", name, ..] if strict || vertices.is_none() || name == "vertex" => {
                    return Err(HeaderError::Element(name.to_owned()));
                }
                ["element", ..] => in_vertex = false,
                ["property", "list", .., name] if in_vertex || strict => {
                    let kind = "list".to_owned();
                    return Err(HeaderError::PropertyType { name: name.to_owned(), kind });
                }
                ["property", kind, name] if in_vertex => {
                    let name = name.to_owned();
                    if strict && properties.iter().any(|property| property.name == name) {
                        return Err(HeaderError::Twice(name));
                    }
                    let Some(scalar) = Scalar::parse(kind) else {
                        return Err(HeaderError::PropertyType { name, kind: kind.to_owned() });
                    };
                    properties.push(Property { name, scalar, offset: stride });
                    stride += scalar.size();
                }
                ["end_header"] => break,
                _ if strict => return Err(not_understood()),
                _ => {}
            }
        }
        let encoding = encoding.ok_or(HeaderError::Missing("format"))?;
        let vertices = vertices.ok_or(HeaderError::Missing("vertices"))?;
        Ok(Self { encoding, vertices, properties, stride, length })
    }

    /// The first property of this name.
    #[must_use]
    pub fn property(&self, name: &str) -> Option<&Property> {
        self.properties.iter().find(|property| property.name == name)
    }
}
