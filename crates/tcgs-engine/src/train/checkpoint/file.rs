//! The file of a checkpoint.
//!
//! The file is safetensors: one tensor for each array of the model's state, and in the metadata `tcgs.checkpoint` (the format
//! version), `run` (JSON: program, options, dataset, step, random generator, remaining photographs of the epoch) and `crc32c` (of
//! `run`, then of the names and bytes of the tensors in the order of their names).

use std::{
    collections::{BTreeMap, HashMap},
    io,
};

use safetensors::{Dtype, SafeTensorError, SafeTensors};
use serde_json::json;

use super::{Checkpoint, CheckpointError, ModelState, VERSION, model_state::Array};

/// Keys of the metadata.
const VERSION_KEY: &str = "tcgs.checkpoint";
const RUN_KEY: &str = "run";
const CHECKSUM_KEY: &str = "crc32c";

impl Checkpoint {
    /// Writes the file.
    ///
    /// # Errors
    /// Those of `out`.
    pub fn write(&self, out: &mut impl io::Write) -> io::Result<()> {
        let run = serde_json::to_string(&self.run)?;
        let arrays = &self.model.0;
        let checksum = arrays.iter().fold(crc32c::crc32c(run.as_bytes()), |sum, (name, array)| {
            extend_checksum(sum, name, array.bytes())
        });
        // By hand: the library's writer needs the whole file in memory, or a path, where it leaves partial files if killed.
        let mut header = serde_json::Map::new();
        header.insert(
            "__metadata__".to_owned(),
            json!({ VERSION_KEY: VERSION, CHECKSUM_KEY: format!("{checksum:08x}"), RUN_KEY: run }),
        );
        let mut end = 0;
        for (name, array) in arrays {
            let begin = end;
            end += array.bytes().len();
            let count = array.bytes().len() / 4;
            let entry = json!({ "dtype": array.dtype(), "shape": [count], "data_offsets": [begin, end] });
            header.insert(name.clone(), entry);
        }
        let mut header = serde_json::to_string(&header)?;
        header.extend(std::iter::repeat_n(' ', header.len().next_multiple_of(8) - header.len()));
        out.write_all(&(header.len() as u64).to_le_bytes())?;
        out.write_all(header.as_bytes())?;
        arrays.values().try_for_each(|array| out.write_all(array.bytes()))
    }

    /// Reads a file.
    ///
    /// # Errors
    /// [`CheckpointError::Format`], [`CheckpointError::Damaged`] or [`CheckpointError::Version`].
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, CheckpointError> {
        let format = |error: SafeTensorError| CheckpointError::Format(error.to_string());
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(format)?;
        let empty = HashMap::new();
        let metadata = header.metadata().as_ref().unwrap_or(&empty);
        let get = |key: &str| {
            let missing = || CheckpointError::Format(format!("the metadata lack '{key}'"));
            metadata.get(key).ok_or_else(missing)
        };
        let version = get(VERSION_KEY)?;
        if version != VERSION {
            return Err(CheckpointError::Version(version.clone()));
        }
        let (run, stated) = (get(RUN_KEY)?, get(CHECKSUM_KEY)?);
        let tensors = SafeTensors::deserialize(bytes).map_err(format)?;
        let tensors: BTreeMap<String, _> = tensors.tensors().into_iter().collect();
        let found = tensors.iter().fold(crc32c::crc32c(run.as_bytes()), |sum, (name, tensor)| {
            extend_checksum(sum, name, tensor.data())
        });
        if *stated != format!("{found:08x}") {
            return Err(CheckpointError::Damaged { found, stated: stated.clone() });
        }
        let run = serde_json::from_str(run).map_err(|error| CheckpointError::Format(error.to_string()))?;
        let arrays = tensors.into_iter().map(|(name, tensor)| {
            let array = Array::from_bytes(tensor.dtype(), tensor.data()).ok_or_else(|| {
                CheckpointError::array(&name, format!("has the unknown type {:?}", tensor.dtype()))
            })?;
            Ok((name, array))
        });
        Ok(Self { run, model: ModelState(arrays.collect::<Result<_, CheckpointError>>()?) })
    }
}

fn extend_checksum(sum: u32, name: &str, bytes: &[u8]) -> u32 {
    crc32c::crc32c_append(crc32c::crc32c_append(sum, name.as_bytes()), bytes)
}

// Arrays are written as in memory, and safetensors is little-endian.
const _: () = assert!(cfg!(target_endian = "little"));

impl Array {
    fn dtype(&self) -> Dtype {
        match self {
            Array::F32(_) => Dtype::F32,
            Array::I32(_) => Dtype::I32,
            Array::U32(_) => Dtype::U32,
        }
    }

    fn bytes(&self) -> &[u8] {
        match self {
            Array::F32(values) => bytemuck::cast_slice(values),
            Array::I32(values) => bytemuck::cast_slice(values),
            Array::U32(values) => bytemuck::cast_slice(values),
        }
    }

    fn from_bytes(dtype: Dtype, bytes: &[u8]) -> Option<Self> {
        match dtype {
            Dtype::F32 => Some(Array::F32(bytemuck::pod_collect_to_vec(bytes))),
            Dtype::I32 => Some(Array::I32(bytemuck::pod_collect_to_vec(bytes))),
            Dtype::U32 => Some(Array::U32(bytemuck::pod_collect_to_vec(bytes))),
            _ => None,
        }
    }
}
