// What XLA calls: one library per precision (PGJAX_DOUBLE). Matrices (n, 3, 3) in; eigenvalues
// (n, 3) and vectors (n, 3, 3) out, or U (n, 3, 3), sigma (n, 3) and V (n, 3, 3).
#include "eigen.h"

#include "xla.h"

namespace {

ffi::Error Eigenbasis(ffi::ThreadPool threads, In A, Out w, Out Q) {
  pgjax::Pool pool = pool_of(threads);
  pgjax::eigenbasis<T>(A.dimensions()[0], A.typed_data(), w->typed_data(), Q->typed_data(), pool);
  return ffi::Error::Success();
}

ffi::Error Svd(ffi::ThreadPool threads, In F, Out U, Out sigma, Out V) {
  pgjax::Pool pool = pool_of(threads);
  pgjax::svd<T>(F.dimensions()[0], F.typed_data(), U->typed_data(), sigma->typed_data(),
                V->typed_data(), pool);
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_eigenbasis, Eigenbasis,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Arg<In>()
                                  .Ret<ffi::Buffer<kType>>().Ret<ffi::Buffer<kType>>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(pgjax_svd, Svd,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().Arg<In>()
                                  .Ret<ffi::Buffer<kType>>().Ret<ffi::Buffer<kType>>()
                                  .Ret<ffi::Buffer<kType>>());
