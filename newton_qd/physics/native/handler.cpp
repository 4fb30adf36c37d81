// Runs the kernels of a CPU when XLA calls them. Nothing here needs Python.
//
// Warp's own compiler builds this file when the first system is loaded. There are no
// headers: the structs of XLA's foreign function interface are written out below, as in
// `xla/ffi/api/c_api.h`, whose layout is stable. Functions of the operating system come
// as addresses from `library.py`, because the linker knows few of them.

typedef long long int64;
typedef decltype(sizeof(0)) size;

extern "C" void* calloc(size, size);
extern "C" void free(void*);
extern "C" void* memcpy(void*, const void*, size);
extern "C" void* memset(void*, int, size);

// ---- XLA's foreign function interface

struct Extension { size struct_size; int type; Extension* next; };
struct Version { size struct_size; Extension* extension; int major, minor; };
struct Metadata { size struct_size; Version version; };
struct MetadataExtension { Extension base; Metadata* metadata; };
struct ErrorArguments { size struct_size; Extension* extension; const char* message; int code; };
struct Api {
    size struct_size;
    Extension* extension;
    Version version;
    const void* internal;
    void* (*create_error)(ErrorArguments*);
};
struct Buffer { size struct_size; Extension* extension; int dtype; char* data; int64 rank; int64* dims; };
struct Buffers { size struct_size; Extension* extension; int64 count; int* types; Buffer** items; };
struct Scalar { int dtype; int64* value; };
struct Attributes { size struct_size; Extension* extension; int64 count; int* types; void** names; Scalar** items; };
struct Call {
    size struct_size;
    Extension* extension;
    const Api* api;
    void* context;
    int stage;
    Buffers inputs, outputs;
    Attributes attributes;
};
enum { METADATA = 1, INVALID_ARGUMENT = 3, CANCELLED = 1, NOT_FOUND = 5, EXHAUSTED = 8 };

// ---- What Python fills in: see `library.py`

struct System {  // functions and numbers of the operating system
    int (*create)(size*, const void*, void* (*)(void*), void*);
    int (*mutex_lock)(void*);
    int (*mutex_unlock)(void*);
    int (*wait)(void*, void*);
    int (*signal)(void*);
    int (*yield)();
    char* (*getenv)(const char*);
    int64 cores;
};

enum { ARRAYS = 3, MEMORIES = 2, WIDEST_PACK = 16, BUCKETS = 1024, WORKERS = 256 };

struct Block {  // what a thread needs to run a kernel
    Block* next;
    char* arguments;
    char* rows;
};

struct Plan {  // a kernel of a system
    int64 key;
    Plan* next;
    void* kernel;
    void* adjoint_arguments;  // null: the kernel runs forward
    void* bounds;
    const char* arguments;
    int64 argument_bytes;
    int64 arrays, array_at[ARRAYS], row[ARRAYS];  // offsets of the pointers, numbers in a row
    int64 number_bytes;
    int64 width;      // worlds of a pack
    int64 worlds_at;  // offset of the number of worlds, -1: none
    int64 memories, memory_at[MEMORIES], memory_bytes;
    int64 packs_per_thread;
    int64 state, control, parameters, fault;  // for rollouts: numbers, and the fault's place
    int64 launches, worlds, most_worlds;        // counters, for tests
    int pool_lock;
    Block* pool;
};

static System os;
static Plan* plans[BUCKETS];
static int stopping;
static int64 stopped;  // calls that ended because of it

// ---- Memory

enum { LINE = 128 };  // memory begins at a multiple of this [bytes]

static char* aligned(char* at) { return at + (-(size)at & (LINE - 1)); }

static int64 row_bytes(const Plan* p) {
    int64 numbers = 0;
    for (int k = 0; k < p->arrays; ++k) numbers += p->row[k];
    return numbers * p->width * p->number_bytes;
}

static Block* take(Plan* p) {
    while (__atomic_exchange_n(&p->pool_lock, 1, __ATOMIC_ACQUIRE)) {}
    Block* block = p->pool;
    if (block) p->pool = block->next;
    __atomic_store_n(&p->pool_lock, 0, __ATOMIC_RELEASE);
    if (block) return block;
    const size memory = p->memory_bytes, rows = row_bytes(p);
    char* whole = (char*)calloc(sizeof(Block) + p->argument_bytes + memory + rows + 4 * LINE, 1);
    if (!whole) return nullptr;
    block = (Block*)whole;
    block->arguments = aligned(whole + sizeof(Block));
    char* scratch = aligned(block->arguments + p->argument_bytes);
    block->rows = aligned(scratch + memory);
    memcpy(block->arguments, p->arguments, p->argument_bytes);
    for (int k = 0; k < p->memories; ++k) *(char**)(block->arguments + p->memory_at[k]) = scratch;
    return block;
}

static void give(Plan* p, Block* block) {
    while (__atomic_exchange_n(&p->pool_lock, 1, __ATOMIC_ACQUIRE)) {}
    block->next = p->pool;
    p->pool = block;
    __atomic_store_n(&p->pool_lock, 0, __ATOMIC_RELEASE);
}

// ---- Packs of worlds

struct Job {
    Plan* plan;
    void (*compute)(const Job*, Block*, int64 pack);
    char* arrays[4];
    int64 worlds, packs, steps;
    int64 next;     // the next pack that nobody has taken
    int64 helpers;  // workers that may still use this job
    int failed;
    unsigned floats;  // how the calling thread treats denormal numbers
};

static void run_kernel(const Plan* p, Block* block, char* const* arrays, int64 worlds) {
    if (p->worlds_at >= 0) *(int*)(block->arguments + p->worlds_at) = (int)worlds;
    for (int k = 0; k < p->arrays; ++k) *(char**)(block->arguments + p->array_at[k]) = arrays[k];
    if (p->adjoint_arguments)
        ((void (*)(void*, void*, void*))p->kernel)(p->bounds, block->arguments, p->adjoint_arguments);
    else
        ((void (*)(void*, void*))p->kernel)(p->bounds, block->arguments);
}

static int64 worlds_of(const Job* job, int64 pack) {
    const int64 rest = job->worlds - pack * job->plan->width;
    return rest < job->plan->width ? rest : job->plan->width;
}

static void compute_rows(const Job* job, Block* block, int64 pack) {
    const Plan* p = job->plan;
    char* arrays[ARRAYS];
    for (int k = 0; k < p->arrays; ++k)
        arrays[k] = job->arrays[k] + pack * p->width * p->row[k] * p->number_bytes;
    run_kernel(p, block, arrays, worlds_of(job, pack));
}

// ---- Rollouts: all steps of a plan, pack by pack

// A row of a rollout is a world: the state, its parameters, then the control of each step.
// Its outputs are those of each step.
template <typename Number> struct Rollout {
    const Plan* p;
    const Job* job;
    int64 first, count;         // worlds
    int64 given;                // numbers of a row
    int64 faulty[WIDEST_PACK];  // step with the first fault of a world
    Number *x, *y, *x_bar;      // rows of one step; of the adjoint, y are those of y_bar

    Rollout(const Job* job, Block* block, int64 pack)
        : p(job->plan), job(job), first(pack * job->plan->width), count(worlds_of(job, pack)) {
        given = p->state + p->parameters + job->steps * p->control;
        x = (Number*)block->rows;
        y = x + p->row[0] * p->width;
        x_bar = y + p->row[1] * p->width;
        for (int64 w = 0; w < count; ++w) faulty[w] = job->steps;
    }
    Number* state(int array, int64 world) const { return (Number*)job->arrays[array] + (first + world) * given; }
    Number* parameters(int array, int64 world) const { return state(array, world) + p->state; }
    Number* control(int array, int64 world, int64 step) const {
        return parameters(array, world) + p->parameters + step * p->control;
    }
    Number* output(int array, int64 world, int64 step) const {
        return (Number*)job->arrays[array] + ((first + world) * job->steps + step) * p->row[1];
    }
    // Fills the inputs of a step. After a fault the control of a world is no number: the
    // physics then keeps its state.
    void read(int64 step) const {
        for (int64 w = 0; w < count; ++w) {
            Number* at = x + w * p->row[0];
            memcpy(at, step ? output(1, w, step - 1) : state(0, w), p->state * sizeof(Number));
            at += p->state;
            memcpy(at, control(0, w, step), p->control * sizeof(Number));
            for (int64 k = 0; step > faulty[w] && k < p->control; ++k) at[k] = __builtin_nanf("");
            memcpy(at + p->control, parameters(0, w), p->parameters * sizeof(Number));
        }
    }
    void look_for_faults(int64 step) {
        for (int64 w = 0; w < count; ++w)
            if (faulty[w] > step && output(1, w, step)[p->fault] != 0) faulty[w] = step;
    }
};

// Arrays: rows, outputs.
template <typename Number> static void roll_out(const Job* job, Block* block, int64 pack) {
    Rollout<Number> r(job, block, pack);
    char* arrays[ARRAYS] = {(char*)r.x, (char*)r.y, nullptr};
    const int64 size = r.p->row[1];
    for (int64 step = 0; step < job->steps; ++step) {
        r.read(step);
        run_kernel(r.p, block, arrays, r.count);
        for (int64 w = 0; w < r.count; ++w) memcpy(r.output(1, w, step), r.y + w * size, size * sizeof(Number));
        r.look_for_faults(step);
    }
}

// Arrays: rows, outputs, adjoints of the outputs, adjoints of the rows.
template <typename Number> static void roll_back(const Job* job, Block* block, int64 pack) {
    Rollout<Number> r(job, block, pack);
    const Plan* p = r.p;
    char* arrays[ARRAYS] = {(char*)r.x, (char*)r.y, (char*)r.x_bar};
    for (int64 step = 0; step < job->steps; ++step) r.look_for_faults(step);
    for (int64 w = 0; w < r.count; ++w) memset(r.state(3, w), 0, (p->state + p->parameters) * sizeof(Number));
    for (int64 step = job->steps; step-- > 0;) {
        r.read(step);
        for (int64 w = 0; w < r.count; ++w) {
            Number* y_bar = r.y + w * p->row[1];
            const Number* later = r.state(3, w);
            memcpy(y_bar, r.output(2, w, step), p->row[1] * sizeof(Number));
            for (int64 k = 0; k < p->state; ++k) y_bar[k] += later[k];
        }
        run_kernel(p, block, arrays, r.count);
        for (int64 w = 0; w < r.count; ++w) {
            const Number* x_bar = r.x_bar + w * p->row[2];
            memcpy(r.state(3, w), x_bar, p->state * sizeof(Number));
            x_bar += p->state;
            memcpy(r.control(3, w, step), x_bar, p->control * sizeof(Number));
            for (int64 k = 0; k < p->parameters; ++k) r.parameters(3, w)[k] += x_bar[p->control + k];
        }
    }
}

// ---- Threads: workers poll for a while before they sleep, as the threads of OpenMP do

enum { POLLS = 2000, WORKING = 1 };

struct Worker {
    Job* job;  // null: idle, WORKING: it has taken its job, else: a job on offer
    int asleep;
    size mutex[16], condition[16];
};

static Worker workers[WORKERS];
static int64 worker_count;
static int start_lock;

#if defined(__x86_64__)
static unsigned read_floats() { return __builtin_ia32_stmxcsr(); }
static void write_floats(unsigned value) { __builtin_ia32_ldmxcsr(value); }
#else
static unsigned read_floats() { return 0; }
static void write_floats(unsigned) {}
#endif

static void work(Job* job) {
    Block* block = take(job->plan);
    if (!block) {
        job->failed = EXHAUSTED;
        return;
    }
    for (;;) {
        if (__atomic_load_n(&stopping, __ATOMIC_RELAXED)) {
            job->failed = CANCELLED;
            break;
        }
        const int64 pack = __atomic_fetch_add(&job->next, 1, __ATOMIC_RELAXED);
        if (pack >= job->packs) break;
        job->compute(job, block, pack);
    }
    give(job->plan, block);
}

static void* serve(void* argument) {
    Worker* own = (Worker*)argument;
    for (int64 polls = 0;;) {
        Job* job = __atomic_load_n(&own->job, __ATOMIC_ACQUIRE);
        if (job && __atomic_compare_exchange_n(&own->job, &job, (Job*)WORKING, false, __ATOMIC_ACQ_REL, __ATOMIC_RELAXED)) {
            write_floats(job->floats);
            work(job);
            __atomic_store_n(&own->job, (Job*)nullptr, __ATOMIC_RELEASE);
            __atomic_sub_fetch(&job->helpers, 1, __ATOMIC_RELEASE);  // the job may end here
            polls = 0;
        } else if (++polls < POLLS) {
            os.yield();
        } else {
            os.mutex_lock(own->mutex);
            __atomic_store_n(&own->asleep, 1, __ATOMIC_SEQ_CST);
            while (!__atomic_load_n(&own->job, __ATOMIC_SEQ_CST)) os.wait(own->condition, own->mutex);
            __atomic_store_n(&own->asleep, 0, __ATOMIC_SEQ_CST);
            os.mutex_unlock(own->mutex);
            polls = 0;
        }
    }
}

static void start_workers(int64 count) {
    if (!os.create || __atomic_exchange_n(&start_lock, 1, __ATOMIC_ACQUIRE)) return;
    while (worker_count < count && worker_count < WORKERS) {
        size thread;
        if (os.create(&thread, nullptr, serve, &workers[worker_count])) break;
        __atomic_store_n(&worker_count, worker_count + 1, __ATOMIC_RELEASE);
    }
    __atomic_store_n(&start_lock, 0, __ATOMIC_RELEASE);
}

// Offers the job to idle workers, works on it, and takes back what nobody has begun.
static void share(Job* job, int64 threads) {
    if (threads - 1 > __atomic_load_n(&worker_count, __ATOMIC_ACQUIRE)) start_workers(threads - 1);
    const int64 count = __atomic_load_n(&worker_count, __ATOMIC_ACQUIRE);
    job->floats = read_floats();
    for (int64 n = 0, offered = 0; n < count && offered < threads - 1; ++n) {
        Job* idle = nullptr;
        __atomic_add_fetch(&job->helpers, 1, __ATOMIC_RELAXED);
        if (__atomic_compare_exchange_n(&workers[n].job, &idle, job, false, __ATOMIC_SEQ_CST, __ATOMIC_RELAXED)) {
            ++offered;
            if (__atomic_load_n(&workers[n].asleep, __ATOMIC_SEQ_CST)) {
                os.mutex_lock(workers[n].mutex);
                os.signal(workers[n].condition);
                os.mutex_unlock(workers[n].mutex);
            }
        } else {
            __atomic_sub_fetch(&job->helpers, 1, __ATOMIC_RELAXED);
        }
    }
    work(job);
    for (int64 n = 0; n < count; ++n) {
        Job* own = job;
        if (__atomic_compare_exchange_n(&workers[n].job, &own, (Job*)nullptr, false, __ATOMIC_ACQ_REL, __ATOMIC_RELAXED))
            __atomic_sub_fetch(&job->helpers, 1, __ATOMIC_RELAXED);
    }
    while (__atomic_load_n(&job->helpers, __ATOMIC_ACQUIRE)) os.yield();
}

// The number in NEWTON_QD_THREADS, or the number of usable cores; 0: not a number.
static int64 thread_count() {
    const char* text = os.getenv ? os.getenv("NEWTON_QD_THREADS") : nullptr;
    if (!text) return os.cores;
    int64 count = 0;
    for (; *text; ++text) {
        if (*text < '0' || *text > '9' || count > 1000000) return 0;
        count = 10 * count + (*text - '0');
    }
    return count;
}

static int run(Job* job) {
    Plan* p = job->plan;
    __atomic_add_fetch(&p->launches, 1, __ATOMIC_RELAXED);
    __atomic_add_fetch(&p->worlds, job->worlds, __ATOMIC_RELAXED);
    if (job->worlds > p->most_worlds) p->most_worlds = job->worlds;
    job->packs = (job->worlds + p->width - 1) / p->width;
    if (!job->packs) return 0;
    int64 threads = thread_count();
    if (threads < 1) return INVALID_ARGUMENT;
    const int64 useful = (job->packs * (job->steps > 8 ? 8 : job->steps) + p->packs_per_thread - 1) / p->packs_per_thread;
    if (threads > useful) threads = useful;
    if (threads > job->packs) threads = job->packs;
    if (threads > 1) share(job, threads);
    else work(job);
    return job->failed;
}

static Plan* find(int64 key) {
    Plan* plan = __atomic_load_n(&plans[(size)key % BUCKETS], __ATOMIC_ACQUIRE);
    while (plan && plan->key != key) plan = plan->next;
    return plan;
}

// ---- Entry points

static int64 numbers(const Buffer* buffer) {
    int64 count = 1;
    for (int64 k = 0; k < buffer->rank; ++k) count *= buffer->dims[k];
    return count;
}

static void* error_of(const Call* call, int code) {
    if (!code) return nullptr;
    ErrorArguments given = {sizeof(ErrorArguments), nullptr, "the physics ran out of memory", code};
    if (code == INVALID_ARGUMENT) given.message = "NEWTON_QD_THREADS: allowed: integers from 1";
    if (code == CANCELLED) {
        given.message = "the physics was stopped, because Python ends";
        __atomic_fetch_add(&stopped, 1, __ATOMIC_RELAXED);
    }
    if (code == NOT_FOUND) given.message = "the physics does not know this kernel";
    return call->api->create_error(&given);
}

// Answers XLA's question for the version of the interface.
static bool describe(const Call* call) {
    if (!call->extension || call->extension->type != METADATA) return false;
    Version* version = &((MetadataExtension*)call->extension)->metadata->version;
    version->major = 0;
    version->minor = 1;
    return true;
}

static void* run_call(const Call* call, bool rollout) {
    if (describe(call)) return nullptr;
    Job job = {};
    job.plan = find(*call->attributes.items[0]->value);
    if (!job.plan) return error_of(call, NOT_FOUND);
    int count = 0;
    for (int64 k = 0; k < call->inputs.count; ++k) job.arrays[count++] = call->inputs.items[k]->data;
    for (int64 k = 0; k < call->outputs.count; ++k) job.arrays[count++] = call->outputs.items[k]->data;
    const Buffer* rows = call->inputs.items[0];
    const Plan* p = job.plan;
    job.steps = 1;
    job.compute = compute_rows;
    int64 given = p->row[0];
    if (rollout) {
        const bool wide = p->number_bytes == 8;
        given = rows->dims[rows->rank - 1];
        job.steps = (given - p->state - p->parameters) / p->control;
        if (p->adjoint_arguments) job.compute = wide ? roll_back<double> : roll_back<float>;
        else job.compute = wide ? roll_out<double> : roll_out<float>;
    }
    job.worlds = numbers(rows) / given;
    return error_of(call, run(&job));
}

extern "C" {

void* newton_qd_rows(const Call* call) { return run_call(call, false); }

void* newton_qd_rollout(const Call* call) { return run_call(call, true); }

// Runs a plan on arrays of rows. Returns 0 or the code of an error.
int newton_qd_run(Plan* plan, int64 worlds, char** arrays) {
    Job job = {};
    job.plan = plan;
    job.compute = compute_rows;
    job.worlds = worlds;
    job.steps = 1;
    for (int k = 0; k < plan->arrays; ++k) job.arrays[k] = arrays[k];
    return run(&job);
}

void newton_qd_start(const System* system, int (*mutex_init)(void*, const void*), int (*condition_init)(void*, const void*)) {
    os = *system;
    for (int n = 0; os.create && n < WORKERS; ++n) {
        mutex_init(workers[n].mutex, nullptr);
        condition_init(workers[n].condition, nullptr);
    }
}

void newton_qd_add(Plan* plan) {
    Plan** bucket = &plans[(size)plan->key % BUCKETS];
    plan->next = *bucket;
    __atomic_store_n(bucket, plan, __ATOMIC_RELEASE);
}

void newton_qd_free(Plan* plan) {
    for (Block* block = plan->pool; block;) {
        Block* next = block->next;
        free(block);
        block = next;
    }
    plan->pool = nullptr;
}

// All kernels that run return an error soon, and so does every later call.
void newton_qd_stop() { __atomic_store_n(&stopping, 1, __ATOMIC_RELAXED); }

// Number of calls from XLA that ended with this error.
int64 newton_qd_stopped() { return __atomic_load_n(&stopped, __ATOMIC_RELAXED); }

}  // extern "C"
