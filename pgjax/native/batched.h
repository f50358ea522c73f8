// Arrays with a leading batch direction as XLA gives them, and what is known when compiling.
#pragma once

#include "transfer.h"
#include "xla.h"

constexpr int D = PGJAX_D;
using namespace pgjax;

namespace {

// Arrays of the given rank, with or without a batch direction in front.
template <class Buffer>
bool is_batched(Buffer& buffer, int rank) {
  return int(buffer.dimensions().size()) > rank;
}
template <class Buffer>
Index batch_size(Buffer& buffer, int rank) {
  return is_batched(buffer, rank) ? buffer.dimensions()[0] : 1;
}
template <class Buffer>
Index batch_step(Buffer& buffer, int rank) {
  const Index size = batch_size(buffer, rank);
  return size == 1 ? 0 : Index(buffer.element_count()) / size;
}
template <ffi::DataType kAny>
Batched<const ffi::NativeType<kAny>> shared_or_each(ffi::Buffer<kAny>& in, int rank) {
  return {in.typed_data(), batch_step(in, rank)};
}
template <ffi::DataType kAny>
Batched<ffi::NativeType<kAny>> each(ffi::Result<ffi::Buffer<kAny>>& out, int rank) {
  return {out->typed_data(), batch_step(*out, rank)};
}

// Nodes along each direction.
template <class Nodes>
std::array<Index, D> nodes_of(Nodes& nodes) {
  std::array<Index, D> n;
  for (int i = 0; i < D; ++i) n[i] = nodes.dimensions()[i + is_batched(nodes, D + 1)];
  return n;
}

template <class Nodes>
Shape<D> shape_of(In& xi, Nodes& nodes) {
  Shape<D> shape;
  shape.particles = xi.dimensions()[is_batched(xi, 2)];
  const auto n = nodes_of(nodes);
  std::copy(n.begin(), n.end(), shape.nodes);
  return shape;
}

// Calls `run` with the width of the stencil and one choice as compile-time constants.
template <class F>
ffi::Error with_kind(std::int64_t degree, bool chosen, const F& run) {
  using std::integral_constant;
  const auto by_choice = [&](auto K) {
    chosen ? run(K, std::true_type{}) : run(K, std::false_type{});
  };
  if (degree == 2)
    by_choice(integral_constant<int, 3>{});
  else if (degree == 3)
    by_choice(integral_constant<int, 4>{});
  else
    return ffi::Error::InvalidArgument("degree must be 2 or 3");
  return ffi::Error::Success();
}

}  // namespace
