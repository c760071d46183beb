"""What schemathesis has to be told of the contract's media types: their bodies are bytes as they are."""

import schemathesis
from hypothesis import strategies as st

for media_type in ("application/zip", "application/x-zip-compressed", "application/offset+octet-stream"):
    schemathesis.openapi.media_type(media_type, st.binary(max_size=4096))


@schemathesis.serializer("application/offset+octet-stream", "application/zip", "application/x-zip-compressed")
def as_bytes(_, value):
    return value if isinstance(value, bytes) else str(value).encode()
