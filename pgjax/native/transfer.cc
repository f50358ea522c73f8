// What XLA calls: one library per precision (PGJAX_DOUBLE) and dimension (PGJAX_D).
//
// Every array has a leading batch direction of length 1 or that of the call. Shapes, `b` being it:
// positions xi (b, p, D); payload a (b, p, 4), B (b, p, D, 4), S (b, p, D, 4); nodes
// (b, n_1, ..., n_D, 4). Without S it has no elements.
#include "transfer.h"

#include "xla.h"

constexpr int D = PGJAX_D;
using namespace pgjax;

namespace {

template <class Buffer>
Index batch_step(Buffer& buffer) {
  const auto dimensions = buffer.dimensions();
  if (dimensions[0] == 1) return 0;
  return Index(buffer.element_count()) / dimensions[0];
}
Batched<const T> shared_or_each(In& in) { return {in.typed_data(), batch_step(in)}; }
Batched<T> each(Out& out) { return {out->typed_data(), batch_step(*out)}; }

Payload<T> payload_of(In& a, In& B, In& S) {
  return {shared_or_each(a), shared_or_each(B), shared_or_each(S)};
}
Moments<T> moments_of(Out& a, Out& B, Out& S) { return {each(a), each(B), each(S)}; }

template <class NodeDimensions>
Shape<D> shape_of(In& xi, NodeDimensions nodes) {
  Shape<D> shape;
  shape.particles = xi.dimensions()[1];
  for (int i = 0; i < D; ++i) shape.nodes[i] = nodes[i + 1];
  return shape;
}

// Calls `run` with the width of the stencil and the presence of S as compile-time constants.
template <class F>
ffi::Error with_kind(std::int64_t degree, bool has_S, const F& run) {
  using std::integral_constant;
  const auto by_S = [&](auto K) {
    has_S ? run(K, std::true_type{}) : run(K, std::false_type{});
  };
  if (degree == 2)
    by_S(integral_constant<int, 3>{});
  else if (degree == 3)
    by_S(integral_constant<int, 4>{});
  else
    return ffi::Error::InvalidArgument("degree must be 2 or 3");
  return ffi::Error::Success();
}

ffi::Error Scatter(ffi::ThreadPool threads, std::int64_t degree, In xi, In a, In B, In S, Out g) {
  Pool pool = pool_of(threads);
  const auto shape = shape_of(xi, g->dimensions());
  return with_kind(degree, S.element_count() > 0, [&](auto K, auto HasS) {
    scatter<T, D, K, HasS>(shape, g->dimensions()[0], shared_or_each(xi), payload_of(a, B, S),
                           each(g), pool);
  });
}

ffi::Error ScatterTangent(ffi::ThreadPool threads, std::int64_t degree, In xi, In a, In B, In S,
                          In dxi, In da, In dB, In dS, Out dg) {
  Pool pool = pool_of(threads);
  const auto shape = shape_of(xi, dg->dimensions());
  return with_kind(degree, S.element_count() > 0, [&](auto K, auto HasS) {
    scatter_tangent<T, D, K, HasS>(shape, dg->dimensions()[0], shared_or_each(xi),
                                   payload_of(a, B, S), shared_or_each(dxi),
                                   payload_of(da, dB, dS), each(dg), pool);
  });
}

ffi::Error Gather(ffi::ThreadPool threads, std::int64_t degree, In xi, In g, Out a, Out B, Out S) {
  Pool pool = pool_of(threads);
  const auto shape = shape_of(xi, g.dimensions());
  return with_kind(degree, S->element_count() > 0, [&](auto K, auto HasS) {
    gather<T, D, K, HasS>(shape, a->dimensions()[0], shared_or_each(xi), shared_or_each(g),
                          moments_of(a, B, S), pool);
  });
}

ffi::Error GatherTangent(ffi::ThreadPool threads, std::int64_t degree, In xi, In g, In dxi, In dg,
                         Out a, Out B, Out S) {
  Pool pool = pool_of(threads);
  const auto shape = shape_of(xi, g.dimensions());
  return with_kind(degree, S->element_count() > 0, [&](auto K, auto HasS) {
    gather_tangent<T, D, K, HasS>(shape, a->dimensions()[0], shared_or_each(xi),
                                  shared_or_each(g), shared_or_each(dxi), shared_or_each(dg),
                                  moments_of(a, B, S), pool);
  });
}

ffi::Error Pull(ffi::ThreadPool threads, std::int64_t degree, In xi, In a, In B, In S, In g,
                Out dxi, Out da, Out dB, Out dS) {
  Pool pool = pool_of(threads);
  const auto shape = shape_of(xi, g.dimensions());
  return with_kind(degree, S.element_count() > 0, [&](auto K, auto HasS) {
    pull<T, D, K, HasS>(shape, dxi->dimensions()[0], shared_or_each(xi), payload_of(a, B, S),
                        shared_or_each(g), each(dxi), moments_of(da, dB, dS), pool);
  });
}

}  // namespace

#define PGJAX_CALL() ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Attr<std::int64_t>("degree")

XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_scatter, Scatter,
                              PGJAX_CALL().Arg<In>().Arg<In>().Arg<In>().Arg<In>()
                                  .Ret<ffi::Buffer<kType>>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_scatter_tangent, ScatterTangent,
                              PGJAX_CALL().Arg<In>().Arg<In>().Arg<In>().Arg<In>()
                                  .Arg<In>().Arg<In>().Arg<In>().Arg<In>()
                                  .Ret<ffi::Buffer<kType>>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_gather, Gather,
                              PGJAX_CALL().Arg<In>().Arg<In>()
                                  .Ret<ffi::Buffer<kType>>().Ret<ffi::Buffer<kType>>()
                                  .Ret<ffi::Buffer<kType>>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_gather_tangent, GatherTangent,
                              PGJAX_CALL().Arg<In>().Arg<In>().Arg<In>().Arg<In>()
                                  .Ret<ffi::Buffer<kType>>().Ret<ffi::Buffer<kType>>()
                                  .Ret<ffi::Buffer<kType>>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_pull, Pull,
                              PGJAX_CALL().Arg<In>().Arg<In>().Arg<In>().Arg<In>().Arg<In>()
                                  .Ret<ffi::Buffer<kType>>().Ret<ffi::Buffer<kType>>()
                                  .Ret<ffi::Buffer<kType>>().Ret<ffi::Buffer<kType>>());
