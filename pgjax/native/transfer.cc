// What XLA calls: one library per precision (PGJAX_DOUBLE) and dimension (PGJAX_D).
//
// Every array has a leading batch direction of length 1 or that of the call. Shapes, `b` being it:
// positions xi (b, p, D); payload a (b, p, 4), B (b, p, D, 4), S (b, p, D, 4); nodes
// (b, n_1, ..., n_D, 4). Without S it has no elements.
#include "batched.h"

namespace {

Payload<T> payload_of(In& a, In& B, In& S) {
  return {shared_or_each(a, 2), shared_or_each(B, 3), shared_or_each(S, 3)};
}
Moments<T> moments_of(Out& a, Out& B, Out& S) { return {each(a, 2), each(B, 3), each(S, 3)}; }

ffi::Error Scatter(ffi::ThreadPool threads, std::int64_t degree, In xi, In a, In B, In S, Out g) {
  Pool pool = pool_of(threads);
  const auto shape = shape_of(xi, *g);
  return with_kind(degree, S.element_count() > 0, [&](auto K, auto HasS) {
    scatter<T, D, K, HasS>(shape, g->dimensions()[0], shared_or_each(xi, 2), payload_of(a, B, S),
                           each(g, D + 1), pool);
  });
}

ffi::Error ScatterTangent(ffi::ThreadPool threads, std::int64_t degree, In xi, In a, In B, In S,
                          In dxi, In da, In dB, In dS, Out dg) {
  Pool pool = pool_of(threads);
  const auto shape = shape_of(xi, *dg);
  return with_kind(degree, S.element_count() > 0, [&](auto K, auto HasS) {
    scatter_tangent<T, D, K, HasS>(shape, dg->dimensions()[0], shared_or_each(xi, 2),
                                   payload_of(a, B, S), shared_or_each(dxi, 2),
                                   payload_of(da, dB, dS), each(dg, D + 1), pool);
  });
}

ffi::Error Gather(ffi::ThreadPool threads, std::int64_t degree, In xi, In g, Out a, Out B, Out S) {
  Pool pool = pool_of(threads);
  const auto shape = shape_of(xi, g);
  return with_kind(degree, S->element_count() > 0, [&](auto K, auto HasS) {
    gather<T, D, K, HasS>(shape, a->dimensions()[0], shared_or_each(xi, 2), shared_or_each(g, D + 1),
                          moments_of(a, B, S), pool);
  });
}

ffi::Error GatherTangent(ffi::ThreadPool threads, std::int64_t degree, In xi, In g, In dxi, In dg,
                         Out a, Out B, Out S) {
  Pool pool = pool_of(threads);
  const auto shape = shape_of(xi, g);
  return with_kind(degree, S->element_count() > 0, [&](auto K, auto HasS) {
    gather_tangent<T, D, K, HasS>(shape, a->dimensions()[0], shared_or_each(xi, 2),
                                  shared_or_each(g, D + 1), shared_or_each(dxi, 2), shared_or_each(dg, D + 1),
                                  moments_of(a, B, S), pool);
  });
}

ffi::Error Pull(ffi::ThreadPool threads, std::int64_t degree, In xi, In a, In B, In S, In g,
                Out dxi, Out da, Out dB, Out dS) {
  Pool pool = pool_of(threads);
  const auto shape = shape_of(xi, g);
  return with_kind(degree, S.element_count() > 0, [&](auto K, auto HasS) {
    pull<T, D, K, HasS>(shape, dxi->dimensions()[0], shared_or_each(xi, 2), payload_of(a, B, S),
                        shared_or_each(g, D + 1), each(dxi, 2), moments_of(da, dB, dS), pool);
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
