//! The state of a model in training, as named arrays.

use std::collections::BTreeMap;

use super::CheckpointError;

/// An array of one of the element types.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::train) enum Array {
    /// Reals.
    F32(Vec<f32>),
    /// Signed integers.
    I32(Vec<i32>),
    /// Unsigned integers.
    U32(Vec<u32>),
}

/// An element type of [`Array`].
pub(in crate::train) trait Element: Sized {
    /// The array that owns `values`.
    fn wrap(values: Vec<Self>) -> Array;
    /// The values of an array of this type.
    fn unwrap(array: Array) -> Option<Vec<Self>>;
}

macro_rules! element {
    ($type:ty, $variant:ident) => {
        impl Element for $type {
            fn wrap(values: Vec<Self>) -> Array {
                Array::$variant(values)
            }

            fn unwrap(array: Array) -> Option<Vec<Self>> {
                match array {
                    Array::$variant(values) => Some(values),
                    _ => None,
                }
            }
        }
    };
}

element!(f32, F32);
element!(i32, I32);
element!(u32, U32);

/// Everything that a model's next step depends on, by name.
#[derive(Debug, Clone, Default, PartialEq)]
pub(in crate::train) struct ModelState(pub(super) BTreeMap<String, Array>);

impl ModelState {
    /// Adds an array.
    pub(in crate::train) fn put<T: Element>(&mut self, name: &str, values: Vec<T>) {
        self.0.insert(name.to_owned(), T::wrap(values));
    }

    /// Whether there is an array of this name.
    pub(in crate::train) fn has(&self, name: &str) -> bool {
        self.0.contains_key(name)
    }

    /// Takes an array out.
    ///
    /// # Errors
    /// [`CheckpointError::Array`] if it is missing or of another type.
    pub(in crate::train) fn take<T: Element>(&mut self, name: &str) -> Result<Vec<T>, CheckpointError> {
        let array = self.0.remove(name).ok_or_else(|| CheckpointError::array(name, "is missing"))?;
        T::unwrap(array).ok_or_else(|| CheckpointError::array(name, "is of another type"))
    }

    /// Takes an array of exactly `len` values out.
    ///
    /// # Errors
    /// [`CheckpointError::Array`] if it is missing, of another type or of another length.
    pub(in crate::train) fn take_exactly<T: Element>(
        &mut self,
        name: &str,
        len: usize,
    ) -> Result<Vec<T>, CheckpointError> {
        let values = self.take(name)?;
        if values.len() == len {
            return Ok(values);
        }
        Err(CheckpointError::array(name, format!("has {} values where {len} are needed", values.len())))
    }

    /// Checks that everything was taken.
    ///
    /// # Errors
    /// [`CheckpointError::Array`] naming an array that the model does not have.
    pub(in crate::train) fn finish(self) -> Result<(), CheckpointError> {
        match self.0.keys().next() {
            Some(name) => Err(CheckpointError::array(name, "is not part of this model")),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_taken_must_be_what_was_put() {
        let mut state = ModelState::default();
        state.put("a", vec![1.5_f32, -0.0]);
        state.put("b", vec![7_u32]);
        state.put("c", vec![-1_i32]);
        assert_eq!(state.take_exactly::<f32>("a", 2).expect("as it was put"), [1.5, -0.0]);
        let text = |error: Result<Vec<u32>, CheckpointError>| error.expect_err("a fault").to_string();
        assert_eq!(text(state.take("a")), "the checkpoint's array 'a' is missing");
        assert!(text(state.take("c")).contains("'c' is of another type"));
        assert!(text(state.take_exactly("b", 2)).contains("'b' has 1 values where 2 are needed"));
        state.finish().expect("nothing is left");
        let mut more = ModelState::default();
        more.put("d", vec![1_u32]);
        assert!(more.finish().expect_err("left over").to_string().contains("'d' is not part of this model"));
    }
}
