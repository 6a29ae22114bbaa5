#pragma once

/// GP2_API opens namespace gp2 in every public header. A shared gp2 exports what they declare and hides the rest, JSON and TOML
/// among it; of a static one all is hidden, so that a plug-in that links it re-exports nothing.
#ifdef GP2_SHARED
#define GP2_API __attribute__((visibility("default")))
#else
#define GP2_API
#endif
