// Rows shared between threads: functions of the library, called on parts of the rows side by side.
//
// The workers are the library's own and stay for the next call. With a pool of Python's threads two of them paid from
// 512 highways on, with these from 128: a decision of 256 took 0.46 ms there, 0.44 on one thread, and takes 0.29.

#include <pthread.h>
#include <time.h>

namespace {

// A thread that waits looks for so long before it sleeps: to be woken took 100 us on a virtual machine.
const long PATIENCE_NS = 100000;

long now_ns() {
    timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000000000L + now.tv_nsec;
}

// Waits until `is_so()`, or until patience ends.
template <class Answer>
void look_whether(Answer is_so) {
    for (long until = now_ns() + PATIENCE_NS; !is_so() && now_ns() < until;) continue;
}

struct Call {  // a function of `pointers` pointers, 1 or 3, the first row, and the row behind the last
    void* function;
    int pointers;
    const void* arguments[3];
    long rows, share;  // in all, and of a part
};

int on_rows(const Call& call, long first, long last) {
    const void* const* a = call.arguments;
    if (call.pointers == 1) return ((int (*)(const void*, long, long))call.function)(a[0], first, last);
    typedef int (*OfThree)(const void*, const void*, const void*, long, long);
    return ((OfThree)call.function)(a[0], a[1], a[2], first, last);
}

const int MOST_WORKERS = 255;

// Who holds `caller` posts a call; workers wait for the next turn.
struct Pool {
    pthread_mutex_t caller = PTHREAD_MUTEX_INITIALIZER;  // held by whom the workers work for
    pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;    // of all below
    pthread_cond_t begins = PTHREAD_COND_INITIALIZER, is_done = PTHREAD_COND_INITIALIZER;
    Call call = {};
    long turn = 0;                 // counts calls; this and `open` are looked at without the lock, too
    int parts = 0;                 // of the present call; the caller does the first one
    int open = 0;                  // of them, those of workers that have not finished
    int code = 0;                  // the largest that a worker's part returned
    int workers = 0;               // that there are; number k does part k, from 1
    long first_turn[MOST_WORKERS + 1] = {};  // the turn before a worker's first one
};

Pool pool;

void* work(void* number) {
    long part = (long)number, seen = pool.first_turn[part];
    for (;;) {
        look_whether([&] { return __atomic_load_n(&pool.turn, __ATOMIC_ACQUIRE) != seen; });
        pthread_mutex_lock(&pool.lock);
        while (pool.turn == seen) pthread_cond_wait(&pool.begins, &pool.lock);
        seen = pool.turn;
        Call call = pool.call;
        bool has_part = part < pool.parts;
        pthread_mutex_unlock(&pool.lock);
        if (!has_part) continue;
        long first = part * call.share, last = first + call.share;
        int code = on_rows(call, first, last < call.rows ? last : call.rows);
        pthread_mutex_lock(&pool.lock);
        if (code > pool.code) pool.code = code;
        if (__atomic_sub_fetch(&pool.open, 1, __ATOMIC_RELEASE) == 0) pthread_cond_signal(&pool.is_done);
        pthread_mutex_unlock(&pool.lock);
    }
}

// Of a forked process: it has the pool's memory, but none of its threads.
void forget_workers() { pool = Pool(); }

// Makes workers until there are `wanted`. Returns whether there are.
bool has_workers(int wanted) {
    static bool is_registered = false;  // a forked process has it registered, too
    if (!is_registered) is_registered = pthread_atfork(nullptr, nullptr, forget_workers) == 0;
    if (!is_registered || wanted > MOST_WORKERS) return false;
    while (pool.workers < wanted) {
        long number = pool.workers + 1;
        pool.first_turn[number] = pool.turn;
        pthread_t thread;
        if (pthread_create(&thread, nullptr, work, (void*)number)) return false;
        pthread_detach(thread);
        pool.workers++;
    }
    return true;
}

}  // namespace

// Calls `function` on all `rows`, `share` of them in each part, side by side. Returns the largest of what it returned.
// Where no workers can be had, or they work for another thread, this one does all rows.
extern "C" int ganlane_in_threads(void* function, int pointers, const void* first, const void* second, const void* third,
                                  long rows, long share) {
    Call call = {function, pointers, {first, second, third}, rows, share};
    int parts = (int)((rows + share - 1) / share);
    if (parts < 2 || pthread_mutex_trylock(&pool.caller)) return on_rows(call, 0, rows);
    if (!has_workers(parts - 1)) {
        pthread_mutex_unlock(&pool.caller);
        return on_rows(call, 0, rows);
    }
    pthread_mutex_lock(&pool.lock);
    pool.call = call;
    pool.parts = parts;
    pool.open = parts - 1;
    pool.code = 0;
    __atomic_add_fetch(&pool.turn, 1, __ATOMIC_RELEASE);
    pthread_cond_broadcast(&pool.begins);
    pthread_mutex_unlock(&pool.lock);
    int code = on_rows(call, 0, share);
    look_whether([] { return __atomic_load_n(&pool.open, __ATOMIC_ACQUIRE) == 0; });
    pthread_mutex_lock(&pool.lock);
    while (pool.open) pthread_cond_wait(&pool.is_done, &pool.lock);
    if (pool.code > code) code = pool.code;
    pthread_mutex_unlock(&pool.lock);
    pthread_mutex_unlock(&pool.caller);
    return code;
}
