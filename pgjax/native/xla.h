// What every handler of XLA needs: number type, buffers, threads.
#pragma once

#include "parallel.h"
#include "xla/ffi/api/ffi.h"

#ifdef PGJAX_DOUBLE
using T = double;
constexpr auto kType = xla::ffi::F64;
#else
using T = float;
constexpr auto kType = xla::ffi::F32;
#endif

namespace ffi = xla::ffi;
using In = ffi::Buffer<kType>;
using Out = ffi::Result<ffi::Buffer<kType>>;

inline pgjax::Pool pool_of(ffi::ThreadPool threads) {
  return pgjax::Pool(threads.num_threads(), [threads](std::function<void()> task) mutable {
    threads.Schedule(std::move(task));
  });
}
